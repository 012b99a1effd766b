// Order of elimination by nested dissection, and the fronts of the Cholesky factor that follow from it.
#pragma once

#include <cstdint>
#include <vector>

#include "cloth_mesh.hpp"
#include "cloth_problem.hpp"

namespace sim_core {

using Graph = std::vector<std::vector<int>>;  // neighbours of each node, sorted, itself included

struct Dissection {
  std::vector<int> order;        // nodes of the graph in the order of elimination
  std::vector<int> pivot_begin;  // (fronts + 1): pieces of `order`, children before parents
  std::vector<int> parent;       // (fronts): -1 at the root
};

// Bisects along the longer side of what is left, by the coordinates of the mesh at rest [George 1973].
Dissection nested_dissection(const Graph& graph, const Points2& points);

// The arrays behind a Factor.
struct FactorStorage {
  std::vector<int> pivot_begin, row_begin, rows, parent_row, children, waiting;
  std::vector<int> entry_slot, entry_block, entry_row, entry_column;
  std::vector<long> panel_begin, entry_begin, starts;
  std::vector<float> panels, stack, local;
  double flops = 0.0;

  // `graph` in the numbers of the order of elimination; slots as in ClothMatrix.
  FactorStorage(const Graph& graph, const Dissection& dissection, const std::vector<int>& bending_begin,
                const std::vector<int>& bending_node, const std::vector<int>& membrane_begin,
                const std::vector<int>& membrane_node);

  Factor view();
};

}  // namespace sim_core
