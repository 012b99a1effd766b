// Dense pieces of the factor: C -= A B^T in tiles of registers, and the Cholesky factor of a few columns.
#pragma once

#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

inline int padded(int rows) { return (rows + front_padding - 1) / front_padding * front_padding; }

// C -= A B^T for rows of A in whole vectors and `columns` <= 6 columns; A(i, p) = a[p ld + i], B(j, p) = b[p ld + j].
template <int vectors, int columns>
inline void multiply_tile(const float* a, const float* b, long ld, int depth, float* c, long ldc) {
  Floats sum[vectors][columns];
  for (int v = 0; v < vectors; ++v) {
    for (int j = 0; j < columns; ++j) sum[v][j] = Floats{};
  }
  for (int p = 0; p < depth; ++p) {
    Floats left[vectors];
#pragma GCC unroll 4
    for (int v = 0; v < vectors; ++v) left[v] = *reinterpret_cast<const Floats*>(a + p * ld + CLOTH_FLOATS * v);
#pragma GCC unroll 8
    for (int j = 0; j < columns; ++j) {
      const float right = b[p * ld + j];
#pragma GCC unroll 4
      for (int v = 0; v < vectors; ++v) sum[v][j] += left[v] * right;
    }
  }
  for (int j = 0; j < columns; ++j) {
    for (int v = 0; v < vectors; ++v) {
      *reinterpret_cast<Floats*>(c + j * ldc + CLOTH_FLOATS * v) -= sum[v][j];
    }
  }
}

template <int columns>
inline void multiply_column(const float* a, const float* b, long ld, int depth, float* c, long ldc, int rows) {
  int i = 0;
  for (; i + 2 * CLOTH_FLOATS <= rows; i += 2 * CLOTH_FLOATS) {
    multiply_tile<2, columns>(a + i, b, ld, depth, c + i, ldc);
  }
  for (; i < rows; i += CLOTH_FLOATS) multiply_tile<1, columns>(a + i, b, ld, depth, c + i, ldc);
}

// Lower part of C -= A A^T (square of `columns`, `rows` >= columns padded): tiles that touch the diagonal are whole.
inline void subtract_square(const float* a, long ld, int depth, float* c, long ldc, int rows, int columns) {
  for (int j = 0; j < columns; j += 6) {
    const int from = j / CLOTH_FLOATS * CLOTH_FLOATS;
    const float* left = a + from;
    float* target = c + j * ldc + from;
    switch (columns - j) {
      case 1:
        multiply_column<1>(left, a + j, ld, depth, target, ldc, rows - from);
        break;
      case 2:
        multiply_column<2>(left, a + j, ld, depth, target, ldc, rows - from);
        break;
      case 3:
        multiply_column<3>(left, a + j, ld, depth, target, ldc, rows - from);
        break;
      case 4:
        multiply_column<4>(left, a + j, ld, depth, target, ldc, rows - from);
        break;
      case 5:
        multiply_column<5>(left, a + j, ld, depth, target, ldc, rows - from);
        break;
      default:
        multiply_column<6>(left, a + j, ld, depth, target, ldc, rows - from);
        break;
    }
  }
}

constexpr int block_columns = 16;

// Factor `width` columns of a panel from its diagonal down to `rows`, all earlier columns being subtracted already.
inline void factor_columns(float* panel, long ld, int width, int rows) {
  float l[block_columns][block_columns], inverse[block_columns];
  for (int j = 0; j < width; ++j) {
    float pivot = panel[j * ld + j];
    const float own = pivot;
    for (int q = 0; q < j; ++q) pivot -= l[j][q] * l[j][q];
    if (!(pivot > 1e-6f * own)) pivot = own > 0.0f ? 1e-6f * own : 1.0f;  // rounding: the factor may be inexact
    l[j][j] = __builtin_sqrtf(pivot);
    inverse[j] = 1.0f / l[j][j];
    for (int i = j + 1; i < width; ++i) {
      float sum = panel[j * ld + i];
      for (int q = 0; q < j; ++q) sum -= l[i][q] * l[j][q];
      l[i][j] = sum * inverse[j];
    }
  }
  const int below = (width + CLOTH_FLOATS - 1) / CLOTH_FLOATS * CLOTH_FLOATS;
  for (int i = below; i < rows; i += CLOTH_FLOATS) {
    Floats v[block_columns];
    for (int j = 0; j < width; ++j) {
      Floats sum = *reinterpret_cast<const Floats*>(panel + j * ld + i);
      for (int q = 0; q < j; ++q) sum -= v[q] * l[j][q];
      v[j] = sum * inverse[j];
      *reinterpret_cast<Floats*>(panel + j * ld + i) = v[j];
    }
  }
  // Rows between the block and the first whole vector.
  for (int i = width; i < below && i < rows; ++i) {
    for (int j = 0; j < width; ++j) {
      float sum = panel[j * ld + i];
      for (int q = 0; q < j; ++q) sum -= panel[q * ld + i] * l[j][q];
      panel[j * ld + i] = sum * inverse[j];
    }
  }
  for (int j = 0; j < width; ++j) {
    for (int i = j; i < width; ++i) panel[j * ld + i] = l[i][j];
  }
}

}  // namespace
}  // namespace sim_core
