// Product of Newton's matrix with a vector, and what contact makes of it.
#pragma once

#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

inline void add_folds(const FoldData& folds, const Node* in, Node* out) {
  for (int f = 0; f < folds.count; ++f) {
    const Node* vectors = reinterpret_cast<const Node*>(folds.vectors);
    Node along_a{}, along_b{};
    for (int e = folds.begin[f]; e < folds.begin[f + 1]; ++e) {
      const Node v = in[folds.nodes[e]];
      along_a += vectors[2L * e] * v;
      along_b += vectors[2L * e + 1] * v;
    }
    const float a = along_a[0] + along_a[1] + along_a[2], b = along_b[0] + along_b[1] + along_b[2];
    const float aa = folds.coefficients[2L * f], ab = folds.coefficients[2L * f + 1];
    const Node to_a = spread(aa * a + ab * b), to_b = spread(ab * a);
    for (int e = folds.begin[f]; e < folds.begin[f + 1]; ++e) {
      out[folds.nodes[e]] += to_a * vectors[2L * e] + to_b * vectors[2L * e + 1];
    }
  }
}

inline void add_pairs(const PairData& pairs, const Node* in, Node* out) {
  for (int p = 0; p < pairs.count; ++p) {
    const int* nodes = pairs.nodes + 4L * p;
    const float* weights = pairs.weights + 12L * p;
    const Node* column = reinterpret_cast<const Node*>(pairs.stiffness) + 27L * p;
    Node force[3] = {};
    for (int b = 0; b < 3; ++b) {
      Node motion{};
      for (int c = 0; c < 4; ++c) {
        if (nodes[c] >= 0) motion += spread(weights[4 * b + c]) * in[nodes[c]];
      }
      for (int r = 0; r < 3; ++r, column += 3) {
        for (int a = 0; a < 3; ++a) force[a] += column[a] * spread(motion[r]);
      }
    }
    for (int c = 0; c < 4; ++c) {
      if (nodes[c] < 0) continue;
      out[nodes[c]] +=
          spread(weights[c]) * force[0] + spread(weights[4 + c]) * force[1] + spread(weights[8 + c]) * force[2];
    }
  }
}

// y = K x, without the rows of nodes that stick where there is a `mode`.
inline void apply_rows(const ClothMatrix& matrix, const int* mode, const float* x, float* y) {
  const Node* in = reinterpret_cast<const Node*>(x);
  Node* out = reinterpret_cast<Node*>(y);
  for (int i = 0; i < matrix.nodes; ++i) {
    if (mode && mode[i] == contact_stick) {
      out[i] = Node{};
      continue;
    }
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
  add_folds(*matrix.folds, in, out);
  if (matrix.pairs) add_pairs(*matrix.pairs, in, out);
}

void apply(const ClothMatrix& matrix, const float* x, float* y) { apply_rows(matrix, nullptr, x, y); }

// Sets to zero what contact forbids: the normal part where a node slips, all where it sticks.
inline void admit(const ContactRows& contact, int nodes, float* v) {
  for (int i = 0; i < nodes; ++i) {
    Node* at = reinterpret_cast<Node*>(v) + i;
    if (contact.mode[i] == contact_stick) {
      *at = Node{};
    } else if (contact.mode[i] == contact_slip) {
      const Node n = *(reinterpret_cast<const Node*>(contact.normal) + i);
      *at -= spread(dot3(n, *at)) * n;
    }
  }
}

// y = J v for an admissible v: a slipping node's friction follows its normal force and turns with its motion.
inline void apply_contact(const ClothMatrix& matrix, const ContactRows& contact, const float* v, float* y) {
  apply_rows(matrix, contact.mode, v, y);
  for (int i = 0; i < matrix.nodes; ++i) {
    Node* at = reinterpret_cast<Node*>(y) + i;
    if (contact.mode[i] == contact_stick) {
      *at = Node{};
    } else if (contact.mode[i] == contact_slip) {
      const Node n = *(reinterpret_cast<const Node*>(contact.normal) + i);
      const Node t = *(reinterpret_cast<const Node*>(contact.direction) + i);
      const Node own = *(reinterpret_cast<const Node*>(v) + i);
      const float normal = dot3(n, *at);
      *at -= spread(normal) * n;
      *at += spread(contact.turning[i]) * (own - spread(dot3(t, own)) * t) - spread(contact.mu[i] * normal) * t;
    }
  }
}

}  // namespace
}  // namespace sim_core
