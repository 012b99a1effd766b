// Product of Newton's matrix with a vector, what contact makes of it, and flexible GMRES.
#pragma once

#include "cloth/kernels/triangular.hpp"
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
    const float* coefficients = folds.coefficients + 3L * f;
    const float aa = coefficients[0], ab = coefficients[1], bb = coefficients[2];
    const Node to_a = spread(aa * a + ab * b), to_b = spread(ab * a + bb * b);
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
      out[nodes[c]] += spread(weights[c]) * force[0] + spread(weights[4 + c]) * force[1] +
                       spread(weights[8 + c]) * force[2];
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

void apply(const ClothMatrix& matrix, const float* x, float* y) {
  apply_rows(matrix, nullptr, x, y);
}

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

// Makes y = K v that of J for an admissible v: a slipping node's friction follows its normal force
// and turns with its motion.
inline void follow_friction(const ClothMatrix& matrix, const ContactRows& contact, const float* v,
                            float* y) {
  for (int i = 0; i < matrix.nodes; ++i) {
    Node* at = reinterpret_cast<Node*>(y) + i;
    if (contact.mode[i] == contact_stick) {
      *at = Node{};
    } else if (contact.mode[i] == contact_slip) {
      const Node n = *(reinterpret_cast<const Node*>(contact.normal) + i);
      const Node t = *(reinterpret_cast<const Node*>(contact.direction) + i);
      const Node value = *(reinterpret_cast<const Node*>(v) + i);
      const float normal = dot3(n, *at);
      *at -= spread(normal) * n;
      *at += spread(contact.turn_stiffness[i]) * (value - spread(dot3(t, value)) * t) -
             spread(contact.coupling[i] * normal) * t;
    }
  }
}

// y = J v for an admissible v.
inline void apply_contact(const ClothMatrix& matrix, const ContactRows& contact, const float* v,
                          float* y) {
  apply_rows(matrix, contact.mode, v, y);
  follow_friction(matrix, contact, v, y);
}

inline double product(const float* a, const float* b, long count) {
  Floats sum[4] = {};
  long i = 0;
  for (; i + 4 * CLOTH_FLOATS <= count; i += 4 * CLOTH_FLOATS) {
    for (int v = 0; v < 4; ++v) {
      sum[v] += *reinterpret_cast<const Floats*>(a + i + CLOTH_FLOATS * v) *
                *reinterpret_cast<const Floats*>(b + i + CLOTH_FLOATS * v);
    }
  }
  double total = 0.0;
  for (; i < count; ++i) total += double(a[i]) * b[i];
  for (int v = 0; v < 4; ++v) {
    for (int l = 0; l < CLOTH_FLOATS; ++l) total += sum[v][l];
  }
  return total;
}

inline void add_multiple(float* a, float factor, const float* b, long count) {
  for (long i = 0; i < count; ++i) a[i] += factor * b[i];
}

// Flexible GMRES [Saad 1993], preconditioned from the right by the stale factor. `x`: the first
// guess, of which the best multiple is taken, and the solution. `work`: 2 krylov_max + 1 vectors.
int krylov(const ClothMatrix& matrix, const Factor& factor, const ContactRows& contact,
           const float* b, float* x, float* work, double tolerance) {
  const FlushTiny flush;
  const long count = 4L * matrix.nodes;
  float* basis = work;
  float* images = work + (krylov_max + 1) * count;
  double h[krylov_max + 1][krylov_max], cosine[krylov_max], sine[krylov_max], g[krylov_max + 1];
  for (long i = 0; i < count; ++i) basis[i] = b[i];
  admit(contact, matrix.nodes, basis);
  const double size = __builtin_sqrt(product(basis, basis, count));
  double left = size;
  admit(contact, matrix.nodes, x);
  if (product(x, x, count) > 0.0) {
    apply_contact(matrix, contact, x, images);
    const float scale = float(product(basis, images, count) / product(images, images, count));
    for (long i = 0; i < count; ++i) x[i] *= scale;
    add_multiple(basis, -scale, images, count);
    left = __builtin_sqrt(product(basis, basis, count));
  }
  if (!(left > tolerance * size)) return 0;
  for (long i = 0; i < count; ++i) basis[i] = float(basis[i] / left);
  g[0] = left;
  int k = 0;
  while (k < krylov_max) {
    float *next = basis + (k + 1) * count, *z = images + k * count;
    solve(factor, matrix.nodes, basis + k * count, z);
    admit(contact, matrix.nodes, z);
    apply_contact(matrix, contact, z, next);
    for (int j = 0; j <= k; ++j) {
      h[j][k] = product(next, basis + j * count, count);
      add_multiple(next, float(-h[j][k]), basis + j * count, count);
    }
    h[k + 1][k] = __builtin_sqrt(product(next, next, count));
    const bool exhausted = !(h[k + 1][k] > 1e-12 * size);
    if (!exhausted) {
      const float scale = float(1.0 / h[k + 1][k]);
      for (long i = 0; i < count; ++i) next[i] *= scale;
    }
    for (int j = 0; j < k; ++j) {
      const double up = cosine[j] * h[j][k] + sine[j] * h[j + 1][k];
      h[j + 1][k] = cosine[j] * h[j + 1][k] - sine[j] * h[j][k];
      h[j][k] = up;
    }
    const double length = __builtin_sqrt(h[k][k] * h[k][k] + h[k + 1][k] * h[k + 1][k]);
    if (!(length > 0.0)) break;
    cosine[k] = h[k][k] / length;
    sine[k] = h[k + 1][k] / length;
    h[k][k] = length;
    g[k + 1] = -sine[k] * g[k];
    g[k] *= cosine[k];
    ++k;
    if (exhausted || __builtin_fabs(g[k]) <= tolerance * size) break;
  }
  for (int i = k - 1; i >= 0; --i) {
    for (int j = i + 1; j < k; ++j) g[i] -= h[i][j] * g[j];
    g[i] /= h[i][i];
  }
  for (int j = 0; j < k; ++j) add_multiple(x, float(g[j]), images + j * count, count);
  return k;
}

}  // namespace
}  // namespace sim_core
