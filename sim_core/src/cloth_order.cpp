#include "cloth_order.hpp"

#include <algorithm>
#include <numeric>

namespace sim_core {
namespace {

// Pieces of fewer nodes are eliminated together.
constexpr int piece_max = 16;

struct Dissector {
  const Graph& graph;
  const Points2& points;
  Dissection out;
  std::vector<char> side;

  Dissector(const Graph& graph_in, const Points2& points_in)
      : graph(graph_in), points(points_in), side(graph_in.size(), 0) {}

  int emit(const std::vector<int>& pivots, const std::vector<int>& children) {
    const int front = static_cast<int>(out.parent.size());
    out.order.insert(out.order.end(), pivots.begin(), pivots.end());
    out.pivot_begin.push_back(static_cast<int>(out.order.size()));
    out.parent.push_back(-1);
    for (int child : children) out.parent[child] = front;
    return front;
  }

  int dissect(std::vector<int> nodes) {
    if (static_cast<int>(nodes.size()) <= piece_max) return emit(nodes, {});
    Eigen::Vector2d low = points.row(nodes[0]), high = low;
    for (int i : nodes) {
      low = low.cwiseMin(points.row(i).transpose());
      high = high.cwiseMax(points.row(i).transpose());
    }
    const int axis = high.x() - low.x() >= high.y() - low.y() ? 0 : 1;
    std::sort(nodes.begin(), nodes.end(), [&](int a, int b) {
      const double u = points(a, axis), v = points(b, axis);
      return u != v ? u < v : a < b;
    });
    // The separator is what touches the lower half from above; where the cut falls decides its size.
    std::vector<int> best, best_low, best_high;
    const int size = static_cast<int>(nodes.size());
    for (double share : {0.44, 0.48, 0.5}) {
      std::vector<int> lower(nodes.begin(), nodes.begin() + static_cast<int>(share * size)), cut, upper;
      for (int i : nodes) side[i] = 2;
      for (int i : lower) side[i] = 1;
      for (std::size_t k = lower.size(); k < nodes.size(); ++k) {
        const int i = nodes[k];
        const bool touches = std::any_of(graph[i].begin(), graph[i].end(), [&](int j) { return side[j] == 1; });
        (touches ? cut : upper).push_back(i);
      }
      if (best.empty() || cut.size() < best.size()) best = cut, best_low = lower, best_high = upper;
      for (int i : nodes) side[i] = 0;
    }
    if (best_high.empty() || best_low.empty() || best.size() * 2 > nodes.size()) return emit(nodes, {});
    const int first = dissect(best_low), second = dissect(best_high);
    return emit(best, {first, second});
  }
};

}  // namespace

Dissection nested_dissection(const Graph& graph, const Points2& points) {
  Dissector dissector(graph, points);
  dissector.out.pivot_begin.push_back(0);
  std::vector<int> all(graph.size());
  std::iota(all.begin(), all.end(), 0);
  dissector.dissect(all);
  return dissector.out;
}

FactorStorage::FactorStorage(const Graph& graph, const Dissection& dissection, const std::vector<int>& bending_begin,
                             const std::vector<int>& bending_node, const std::vector<int>& membrane_begin,
                             const std::vector<int>& membrane_node)
    : pivot_begin(dissection.pivot_begin) {
  const int fronts = static_cast<int>(dissection.parent.size());
  children.assign(fronts, 0);
  waiting.assign(fronts, 0);
  starts.assign(fronts, 0);
  std::vector<std::vector<int>> structure(fronts), below(fronts);
  for (int f = 0; f < fronts; ++f) {
    if (dissection.parent[f] >= 0) {
      ++children[dissection.parent[f]];
      below[dissection.parent[f]].push_back(f);
    }
  }
  row_begin.push_back(0);
  entry_begin.push_back(0);
  long panel_end = 0, stack_top = 0, stack_max = 0;
  std::vector<long> held(fronts, 0);
  std::size_t local_max = 0;
  const auto pad = [](long rows) { return (rows + front_padding - 1) / front_padding * front_padding; };
  for (int f = 0; f < fronts; ++f) {
    const int first = pivot_begin[f], last = pivot_begin[f + 1];
    std::vector<int>& own = structure[f];
    for (int i = first; i < last; ++i) {
      for (int j : graph[i]) {
        if (j >= last) own.push_back(j);
      }
    }
    for (int child : below[f]) {
      for (int j : structure[child]) {
        if (j >= last) own.push_back(j);
      }
    }
    std::sort(own.begin(), own.end());
    own.erase(std::unique(own.begin(), own.end()), own.end());
    rows.insert(rows.end(), own.begin(), own.end());
    row_begin.push_back(static_cast<int>(rows.size()));
    const auto place = [&](int node) {
      return node < last
                 ? node - first
                 : last - first + static_cast<int>(std::lower_bound(own.begin(), own.end(), node) - own.begin());
    };
    for (int child : below[f]) {
      for (int r = row_begin[child]; r < row_begin[child + 1]; ++r) {
        if (static_cast<int>(parent_row.size()) <= r) parent_row.resize(r + 1);
        parent_row[r] = place(rows[r]);
      }
    }
    for (int j = first; j < last; ++j) {
      for (int e = bending_begin[j]; e < bending_begin[j + 1]; ++e) {
        const int i = bending_node[e];
        if (i < j) continue;
        entry_slot.push_back(e);
        // Column j of the front holds K_ij: the block in row i of the matrix.
        int block = -1;
        for (int b = membrane_begin[i]; b < membrane_begin[i + 1]; ++b) {
          if (membrane_node[b] == j) block = b;
        }
        entry_block.push_back(block);
        entry_row.push_back(place(i));
        entry_column.push_back(j - first);
      }
    }
    entry_begin.push_back(static_cast<long>(entry_slot.size()));
    const long columns = 3L * (last - first), others = 3L * static_cast<long>(own.size());
    const long ld = pad(columns) + pad(others);
    panel_begin.push_back(panel_end);
    panel_end += ld * columns;
    local_max = std::max(local_max, static_cast<std::size_t>(ld));
    const long update = pad(pad(others) * (others + 6));
    stack_max = std::max(stack_max, stack_top + update);
    for (int child : below[f]) stack_top -= held[child];
    held[f] = own.empty() ? 0 : update;
    stack_top += held[f];
    for (long c = 0; c < columns; ++c) flops += static_cast<double>(columns - c + others) * (columns - c + others);
  }
  parent_row.resize(rows.size());
  panels.assign(panel_end + 64, 0.0f);
  stack.assign(stack_max + 64, 0.0f);
  local.assign(local_max + 64, 0.0f);
}

Factor FactorStorage::view() {
  return {static_cast<int>(children.size()),
          pivot_begin.data(),
          row_begin.data(),
          rows.data(),
          parent_row.data(),
          children.data(),
          panel_begin.data(),
          entry_begin.data(),
          entry_slot.data(),
          entry_block.data(),
          entry_row.data(),
          entry_column.data(),
          panels.data(),
          stack.data(),
          waiting.data(),
          starts.data(),
          local.data()};
}

}  // namespace sim_core
