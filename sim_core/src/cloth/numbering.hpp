// Order of elimination by nested dissection, and the numbers of nodes that follow from it.
#pragma once

#include <cstdint>
#include <vector>

#include "cloth/mesh.hpp"

namespace sim_core {

using Graph = std::vector<std::vector<int>>;  // neighbours of each node, sorted, itself included

struct Dissection {
  std::vector<int> order;        // nodes of the graph in the order of elimination
  std::vector<int> pivot_begin;  // (fronts + 1): pieces of `order`, children before parents
  std::vector<int> parent;       // (fronts): -1 at the root
};

// Bisects along the longest side of the remaining set, by coordinates in the plane or in space
// [George 1973].
Dissection nested_dissection(const Graph& graph, const Eigen::MatrixXd& points);

// Which nodes each row of a matrix has entries for, in compressed rows: those of row i are
// node[begin[i]] ... , ascending.
struct Pattern {
  std::vector<int> begin{0}, node;

  int rows() const { return static_cast<int>(begin.size()) - 1; }
  // Place of (i, j) in `node`; -1 if there is none, as for held nodes.
  int slot(int i, int j) const;
};

// The pattern of a graph in the order of elimination; `place`: of each node in it.
Pattern renumbered(const Graph& from, const std::vector<int>& order, const std::vector<int>& place);

// Free vertices in the order of elimination, then held vertices, then the vertices of surfaces,
// which are no cloth and move as prescribed.
struct Numbering {
  int vertices, surface_vertices, nodes, free_nodes;
  std::vector<int> node, vertex;  // of a vertex or another, and back
  std::vector<int> held;          // nodes of the held vertices, in the caller's order
  Dissection dissection;
  Pattern bending, compact_bending, membrane;  // of the free nodes

  // Throws std::invalid_argument, naming `held`.
  Numbering(const ClothMesh& mesh, const std::vector<Stencil>& stencils,
            const std::vector<Stencil>& compact, const std::vector<std::int32_t>& held,
            int surface_vertices);
};

}  // namespace sim_core
