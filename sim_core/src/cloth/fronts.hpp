// The arrays behind the multifrontal factor: which rows each front has, and what of the matrix goes into it.
#pragma once

#include <vector>

#include "cloth/ordering.hpp"
#include "cloth/problem.hpp"
#include "math/buffer.hpp"

namespace sim_core {

struct FactorStorage {
  std::vector<int> pivot_begin, row_begin, rows, child_begin, children, run_begin;
  std::vector<int> entry_slot, entry_block, entry_row, entry_column;
  std::vector<FrontRun> runs;
  std::vector<long> tile_begin, entry_begin, update_begin;
  Buffer<float> tiles, panel, updates, local;
  double flops = 0.0;

  // Patterns in the numbers of the order of elimination; that of bending holds that of the membrane.
  FactorStorage(const Pattern& bending, const Pattern& membrane, const Dissection& dissection);

  Factor view();
};

}  // namespace sim_core
