// Product of Newton's matrix with a vector.
#pragma once

#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

void apply(const ClothMatrix& matrix, const float* x, float* y) {
  const Node* in = reinterpret_cast<const Node*>(x);
  Node* out = reinterpret_cast<Node*>(y);
  for (int i = 0; i < matrix.nodes; ++i) {
    Node sum = spread(matrix.diagonal[i]) * in[i], other{};
    int e = matrix.bending_begin[i];
    const int end = matrix.bending_begin[i + 1];
    for (; e + 1 < end; e += 2) {
      sum += spread(matrix.bending[e]) * in[matrix.bending_node[e]];
      other += spread(matrix.bending[e + 1]) * in[matrix.bending_node[e + 1]];
    }
    if (e < end) sum += spread(matrix.bending[e]) * in[matrix.bending_node[e]];
    for (int b = matrix.membrane_begin[i]; b < matrix.membrane_begin[i + 1]; ++b) {
      const Node* column = reinterpret_cast<const Node*>(matrix.membrane + 12L * b);
      const Node v = in[matrix.membrane_node[b]];
      sum += column[0] * spread(v[0]) + column[2] * spread(v[2]);
      other += column[1] * spread(v[1]);
    }
    out[i] = sum + other;
  }
}

}  // namespace
}  // namespace sim_core
