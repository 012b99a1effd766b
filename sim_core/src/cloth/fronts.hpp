// The arrays behind the multifrontal factor: which rows each front has, and what of the matrix goes into it.
#pragma once

#include <vector>

#include "cloth/ordering.hpp"
#include "cloth/problem.hpp"
#include "math/buffer.hpp"

namespace sim_core {

struct FactorStorage {
  // Fronts that are made anew together, by one of them: a small subtree by its root, a large front by itself. What
  // waits of it for the parent is kept, so that the parent can be made anew without it.
  std::vector<int> piece;
  std::vector<char> due;
  std::vector<double> work;  // of each front, flops
  std::vector<int> pivot_begin, row_begin, rows, child_begin, children, run_begin;
  std::vector<int> entry_slot, entry_block, entry_row, entry_column;
  std::vector<FrontRun> runs;
  std::vector<long> tile_begin, entry_begin, update_begin;
  Buffer<float> tiles, panel, updates, local;

  // Patterns in the numbers of the order of elimination; that of bending holds that of the membrane.
  FactorStorage(const Pattern& bending, const Pattern& membrane, const Dissection& dissection);

  Factor view();

  // Marks fronts as due: all of them, or those pieces in which `touched` (free nodes) is set, and what they lead to.
  // The latter returns their share of the work.
  void mark_all();
  double mark(const std::vector<char>& touched);
};

}  // namespace sim_core
