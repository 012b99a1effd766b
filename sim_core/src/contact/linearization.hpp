// Rows of Newton's system for pairs of closest points, second derivatives of the distance included.
#pragma once

#include <vector>

#include "contact/pair.hpp"

namespace sim_core {

// Linearizes the law at each pair, at the positions x.
void linearize(std::vector<Pair>& pairs, const Buffer<double>& x);

// Subtracts from nodal forces what the pairs contribute to the right-hand side.
void subtract_right_side(const std::vector<Pair>& pairs, int free_nodes, Buffer<float>& force);

// Rows of the active pairs, for products with the matrix.
class PairRows {
 public:
  PairData assemble(const std::vector<Pair>& pairs, int free_nodes);

 private:
  std::vector<int> nodes_;
  Buffer<float> weights_, stiffness_;
};

}  // namespace sim_core
