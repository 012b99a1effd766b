#include "cloth/ordering.hpp"

#include <algorithm>
#include <numeric>

namespace sim_core {
namespace {

// Pieces of fewer nodes are eliminated together.
constexpr int piece_max = 16;

struct Dissector {
  const Graph& graph;
  const Eigen::MatrixXd& points;
  Dissection out;
  std::vector<char> side;

  Dissector(const Graph& graph_in, const Eigen::MatrixXd& points_in)
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
    Eigen::VectorXd low = points.row(nodes[0]), high = low;
    for (int i : nodes) {
      low = low.cwiseMin(points.row(i).transpose());
      high = high.cwiseMax(points.row(i).transpose());
    }
    int axis = 0;
    (high - low).maxCoeff(&axis);
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

Dissection nested_dissection(const Graph& graph, const Eigen::MatrixXd& points) {
  Dissector dissector(graph, points);
  dissector.out.pivot_begin.push_back(0);
  std::vector<int> all(graph.size());
  std::iota(all.begin(), all.end(), 0);
  if (!all.empty()) dissector.dissect(all);
  return dissector.out;
}

void Pattern::add_row(const std::vector<int>& nodes) {
  node.insert(node.end(), nodes.begin(), nodes.end());
  begin.push_back(static_cast<int>(node.size()));
}

Pattern renumbered(const Graph& from, const std::vector<int>& order, const std::vector<int>& place) {
  Pattern out;
  for (int i : order) {
    std::vector<int> row;
    for (int j : from[i]) row.push_back(place[j]);
    std::sort(row.begin(), row.end());
    out.add_row(row);
  }
  return out;
}

int Pattern::slot(int i, int j) const {
  if (i >= rows()) return -1;
  const auto first = node.begin() + begin[i], last = node.begin() + begin[i + 1];
  const auto at = std::lower_bound(first, last, j);
  return at != last && *at == j ? static_cast<int>(at - node.begin()) : -1;
}

}  // namespace sim_core
