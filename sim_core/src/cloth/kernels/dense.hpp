// Dense pieces of the factor: C -= A B^T in tiles of registers, and the Cholesky factor of a few columns.
#pragma once

#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

inline int padded(int rows) { return (rows + front_padding - 1) / front_padding * front_padding; }

// C -= A B^T, or C = -A B^T where `set`, for rows of A in whole vectors and `columns` <= 6 columns;
// A(i, p) = a[p ld + i], B(j, p) = b[p ld + j].
template <int vectors, int columns, bool set>
inline void multiply_tile(const float* a, const float* b, long ld, int depth, float* c, long ldc) {
  Floats sum[vectors][columns];
#pragma GCC unroll 8
  for (int j = 0; j < columns; ++j) {
#pragma GCC unroll 4
    for (int v = 0; v < vectors; ++v) sum[v][j] = Floats{};
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
#pragma GCC unroll 8
  for (int j = 0; j < columns; ++j) {
#pragma GCC unroll 4
    for (int v = 0; v < vectors; ++v) {
      Floats* out = reinterpret_cast<Floats*>(c + j * ldc + CLOTH_FLOATS * v);
      *out = set ? -sum[v][j] : *out - sum[v][j];
    }
  }
}

template <int columns, bool set>
inline void multiply_column(const float* a, const float* b, long ld, int depth, float* c, long ldc, int rows) {
  int i = 0;
  // Sixteen wide registers hold 2 x 6 sums, thirty-two 4 x 6.
  for (; CLOTH_FLOATS == 16 && i + 4 * CLOTH_FLOATS <= rows; i += 4 * CLOTH_FLOATS) {
    multiply_tile<4, columns, set>(a + i, b, ld, depth, c + i, ldc);
  }
  for (; i + 2 * CLOTH_FLOATS <= rows; i += 2 * CLOTH_FLOATS) {
    multiply_tile<2, columns, set>(a + i, b, ld, depth, c + i, ldc);
  }
  for (; i < rows; i += CLOTH_FLOATS) multiply_tile<1, columns, set>(a + i, b, ld, depth, c + i, ldc);
}

// Lower part of C = -A A^T, a square of `columns`, a multiple of 3; A has `rows` >= columns, padded. Tiles that touch
// the diagonal are whole.
inline void negative_square(const float* a, long ld, int depth, float* c, long ldc, int rows, int columns) {
  for (int j = 0; j < columns; j += 6) {
    const int from = j / CLOTH_FLOATS * CLOTH_FLOATS;
    const float* left = a + from;
    float* target = c + j * ldc + from;
    if (columns - j > 3) {
      multiply_column<6, true>(left, a + j, ld, depth, target, ldc, rows - from);
    } else {
      multiply_column<3, true>(left, a + j, ld, depth, target, ldc, rows - from);
    }
  }
}

// C -= A B^T for the columns j ... j + width of a panel, A and B being the columns before them.
inline void subtract_columns(float* panel, long ld, int j, int width, int rows) {
  const int from = j / CLOTH_FLOATS * CLOTH_FLOATS;
  for (int q = 0; q < width && j > 0; q += 6) {
    float* target = panel + (j + q) * ld + from;
    if (width - q > 3) {
      multiply_column<6, false>(panel + from, panel + j + q, ld, j, target, ld, rows - from);
    } else {
      multiply_column<3, false>(panel + from, panel + j + q, ld, j, target, ld, rows - from);
    }
  }
}

// Factor `width` columns of a panel from its diagonal down to `rows`, all earlier columns being subtracted already.
inline void factor_columns(float* panel, long ld, int width, int rows) {
  float l[tile_columns][tile_columns], inverse[tile_columns];
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
    Floats v[tile_columns];
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

// The inverse of a lower triangle of `width` columns, in columns of tile_rows.
inline void invert_triangle(const float* l, long ld, int width, float* inverse) {
  for (int q = 0; q < width; ++q) {
    float* x = inverse + q * tile_rows;
    x[q] = 1.0f / l[q * ld + q];
    for (int i = q + 1; i < width; ++i) {
      float sum = 0.0f;
      for (int p = q; p < i; ++p) sum -= l[p * ld + i] * x[p];
      x[i] = sum / l[i * ld + i];
    }
  }
}

}  // namespace
}  // namespace sim_core
