// Flexible GMRES.
#pragma once

#include "cloth/kernels/matrix.hpp"
#include "cloth/kernels/triangular.hpp"

namespace sim_core {
namespace {

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

// Flexible GMRES [Saad 1993], preconditioned from the right by the stale factor. `work`: 2 krylov_max + 1 vectors.
int krylov(const ClothMatrix& matrix, const Factor& factor, const ContactRows& contact, const float* b, float* x,
           float* work, int iterations, double tolerance) {
  const FlushTiny flush;
  const long count = 4L * matrix.nodes;
  float* basis = work;
  float* images = work + (krylov_max + 1) * count;
  double h[krylov_max + 1][krylov_max], cosine[krylov_max], sine[krylov_max], g[krylov_max + 1];
  for (long i = 0; i < count; ++i) x[i] = 0.0f;
  for (long i = 0; i < count; ++i) basis[i] = b[i];
  admit(contact, matrix.nodes, basis);
  const double size = __builtin_sqrt(product(basis, basis, count));
  if (!(size > 0.0)) return 0;
  for (long i = 0; i < count; ++i) basis[i] = float(basis[i] / size);
  g[0] = size;
  if (iterations > krylov_max) iterations = krylov_max;
  int k = 0;
  while (k < iterations) {
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
  double y[krylov_max];
  for (int i = k - 1; i >= 0; --i) {
    y[i] = g[i];
    for (int j = i + 1; j < k; ++j) y[i] -= h[i][j] * y[j];
    y[i] /= h[i][i];
  }
  for (int j = 0; j < k; ++j) add_multiple(x, float(y[j]), images + j * count, count);
  return k;
}

}  // namespace
}  // namespace sim_core
