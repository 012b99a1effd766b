#include "cloth/numbering.hpp"

#include <algorithm>
#include <set>

#include "cloth/refusal.hpp"

namespace sim_core {
namespace {

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

Numbering::Numbering(const ClothMesh& mesh, const std::vector<Stencil>& stencils, const std::vector<Stencil>& compact,
                     const std::vector<std::int32_t>& held_vertices, int others_in, int bones_in)
    : vertices(static_cast<int>(mesh.rest.rows())),
      others(others_in),
      bones(bones_in),
      nodes(vertices + others + bones) {
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
  std::vector<std::set<int>> near(free_nodes);
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    for (int a = 0; a < 3; ++a) {
      for (int b = 0; b < 3; ++b) {
        const int i = node[mesh.triangles(t, a)], j = node[mesh.triangles(t, b)];
        if (i < free_nodes && j < free_nodes) near[i].insert(j);
      }
    }
  }
  for (const std::set<int>& row : near) membrane.add_row({row.begin(), row.end()});
}

}  // namespace sim_core
