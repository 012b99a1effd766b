// The arrays behind the multifrontal factor: which rows each front has, and what of the matrix goes into it.
#pragma once

#include <vector>

#include "cloth/ordering.hpp"
#include "cloth/problem.hpp"

namespace sim_core {

struct FactorStorage {
  std::vector<int> pivot_begin, row_begin, rows, parent_row, children, waiting;
  std::vector<int> entry_slot, entry_block, entry_row, entry_column;
  std::vector<long> panel_begin, entry_begin, starts;
  std::vector<float> panels, stack, local;
  double flops = 0.0;

  // Patterns in the numbers of the order of elimination; that of bending holds that of the membrane.
  FactorStorage(const Pattern& bending, const Pattern& membrane, const Dissection& dissection);

  Factor view();
};

}  // namespace sim_core
