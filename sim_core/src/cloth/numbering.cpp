#include "cloth/numbering.hpp"

#include <algorithm>
#include <numeric>
#include <set>

#include "math/refusal.hpp"

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
    // The separator is what touches the lower half from above; where the cut falls decides its
    // size.
    std::vector<int> best, best_low, best_high;
    const int size = static_cast<int>(nodes.size());
    for (double fraction : {0.44, 0.48, 0.5}) {
      std::vector<int> lower(nodes.begin(), nodes.begin() + static_cast<int>(fraction * size)), cut,
          upper;
      for (int i : nodes) side[i] = 2;
      for (int i : lower) side[i] = 1;
      for (std::size_t k = lower.size(); k < nodes.size(); ++k) {
        const int i = nodes[k];
        const bool touches =
            std::any_of(graph[i].begin(), graph[i].end(), [&](int j) { return side[j] == 1; });
        (touches ? cut : upper).push_back(i);
      }
      if (best.empty() || cut.size() < best.size()) best = cut, best_low = lower, best_high = upper;
      for (int i : nodes) side[i] = 0;
    }
    if (best_high.empty() || best_low.empty() || best.size() * 2 > nodes.size())
      return emit(nodes, {});
    const int first = dissect(best_low), second = dissect(best_high);
    return emit(best, {first, second});
  }
};

// Free vertices in ascending order; throws, naming `held`.
std::vector<int> free_of(int vertices, const std::vector<std::int32_t>& held) {
  std::vector<char> is_held(vertices, 0);
  for (std::int32_t h : held) {
    if (h < 0 || h >= vertices) refuse(text("held: must index ", vertices, " vertices, got ", h));
    if (is_held[h]) refuse(text("held: must not repeat a vertex, and repeats ", h));
    is_held[h] = 1;
  }
  std::vector<int> out;
  for (int i = 0; i < vertices; ++i) {
    if (!is_held[i]) out.push_back(i);
  }
  if (out.empty()) refuse("held: must leave a vertex free");
  return out;
}

// Free vertices, numbered by `local`, that share a stencil.
Graph coupled(const std::vector<Stencil>& stencils, const std::vector<int>& local, int count) {
  std::vector<std::set<int>> sets(count);
  for (const Stencil& stencil : stencils) {
    for (int a : stencil.nodes) {
      if (local[a] < 0) continue;
      for (int b : stencil.nodes) {
        if (local[b] >= 0) sets[local[a]].insert(local[b]);
      }
    }
  }
  Graph graph(count);
  for (int i = 0; i < count; ++i) graph[i].assign(sets[i].begin(), sets[i].end());
  return graph;
}

}  // namespace

Dissection nested_dissection(const Graph& graph, const Eigen::MatrixXd& points) {
  Dissector dissector(graph, points);
  dissector.out.pivot_begin.push_back(0);
  std::vector<int> all(graph.size());
  std::iota(all.begin(), all.end(), 0);
  if (!all.empty()) dissector.dissect(all);
  return dissector.out;
}

Pattern renumbered(const Graph& from, const std::vector<int>& order,
                   const std::vector<int>& place) {
  Pattern out;
  for (int i : order) {
    for (int j : from[i]) out.node.push_back(place[j]);
    std::sort(out.node.begin() + out.begin.back(), out.node.end());
    out.begin.push_back(static_cast<int>(out.node.size()));
  }
  return out;
}

int Pattern::slot(int i, int j) const {
  if (i >= rows()) return -1;
  const auto first = node.begin() + begin[i], last = node.begin() + begin[i + 1];
  const auto at = std::lower_bound(first, last, j);
  return at != last && *at == j ? static_cast<int>(at - node.begin()) : -1;
}

Numbering::Numbering(const ClothMesh& mesh, const std::vector<Stencil>& stencils,
                     const std::vector<Stencil>& compact,
                     const std::vector<std::int32_t>& held_vertices, int surface_vertices_in)
    : vertices(static_cast<int>(mesh.rest.rows())),
      surface_vertices(surface_vertices_in),
      nodes(vertices + surface_vertices) {
  const std::vector<int> free_vertices = free_of(vertices, held_vertices);
  free_nodes = static_cast<int>(free_vertices.size());
  std::vector<int> local(vertices, -1);
  Eigen::MatrixXd points(free_nodes, 2);
  for (int i = 0; i < free_nodes; ++i) {
    local[free_vertices[i]] = i;
    points.row(i) = mesh.rest.row(free_vertices[i]);
  }
  const Graph compact_graph = coupled(compact, local, free_nodes);
  dissection = nested_dissection(compact_graph, points);
  node.assign(nodes, -1);
  vertex.assign(nodes, -1);
  std::vector<int> place(free_nodes);
  for (int i = 0; i < free_nodes; ++i) {
    place[dissection.order[i]] = i;
    node[free_vertices[dissection.order[i]]] = i;
  }
  int next = free_nodes;
  for (std::int32_t h : held_vertices) {
    node[h] = next;
    held.push_back(next++);
  }
  for (int i = vertices; i < nodes; ++i) node[i] = next++;
  for (int i = 0; i < nodes; ++i) vertex[node[i]] = i;

  bending = renumbered(coupled(stencils, local, free_nodes), dissection.order, place);
  compact_bending = renumbered(compact_graph, dissection.order, place);
  std::vector<Stencil> corners;
  for (const auto& t : mesh.triangles.rowwise()) corners.push_back({{t[0], t[1], t[2]}, {}});
  membrane = renumbered(coupled(corners, local, free_nodes), dissection.order, place);
}

}  // namespace sim_core
