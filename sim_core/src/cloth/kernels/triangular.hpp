// Triangular solves with the fronts: L y = b from the leaves to the root, L^T x = y back.
#pragma once

#include "cloth/kernels/fronts.hpp"

namespace sim_core {
namespace {

// x = K^-1 b; `x` may be `b`.
void solve(const Factor& factor, int nodes, const float* b, float* x) {
  if (x != b) __builtin_memcpy(x, b, 16L * nodes);
  float* y = factor.local;
  for (int front = 0; front < factor.fronts; ++front) {
    const FrontSize size(factor, front);
    const float* panel = factor.panels + factor.panel_begin[front];
    const int* rows = factor.rows + factor.row_begin[front];
    float* own = x + 4L * factor.pivot_begin[front];
    __builtin_memset(y, 0, sizeof(float) * size.ld);
    for (int i = 0; i < size.pivots; ++i) {
      for (int c = 0; c < 3; ++c) y[3 * i + c] = own[4 * i + c];
    }
    for (int j = 0; j < size.columns; j += block_columns) {
      const int width = size.columns - j < block_columns ? size.columns - j : block_columns;
      const float* block = panel + j * size.ld + j;
      float* z = y + j;
      for (int q = 0; q < width; ++q) {
        z[q] /= block[q * size.ld + q];
        for (int i = q + 1; i < width; ++i) z[i] -= block[q * size.ld + i] * z[q];
      }
      int i = width;
      const int length = int(size.ld) - j;
      for (; i < length && i % CLOTH_FLOATS != 0; ++i) {
        for (int q = 0; q < width; ++q) z[i] -= block[q * size.ld + i] * z[q];
      }
      if (width == block_columns) {
        for (; i < length; i += CLOTH_FLOATS) {
          Floats sum = *reinterpret_cast<const Floats*>(z + i), other{};
#pragma GCC unroll 8
          for (int q = 0; q < block_columns; q += 2) {
            sum -= *reinterpret_cast<const Floats*>(block + q * size.ld + i) * z[q];
            other -= *reinterpret_cast<const Floats*>(block + (q + 1) * size.ld + i) * z[q + 1];
          }
          *reinterpret_cast<Floats*>(z + i) = sum + other;
        }
      } else {
        for (; i < length; i += CLOTH_FLOATS) {
          Floats sum = *reinterpret_cast<const Floats*>(z + i);
          for (int q = 0; q < width; ++q) sum -= *reinterpret_cast<const Floats*>(block + q * size.ld + i) * z[q];
          *reinterpret_cast<Floats*>(z + i) = sum;
        }
      }
    }
    for (int i = 0; i < size.pivots; ++i) {
      for (int c = 0; c < 3; ++c) own[4 * i + c] = y[3 * i + c];
    }
    for (int i = 0; i < size.rows; ++i) {
      float* at = x + 4L * rows[i];
      for (int c = 0; c < 3; ++c) at[c] += y[size.pivot_rows + 3 * i + c];
    }
  }
  for (int front = factor.fronts - 1; front >= 0; --front) {
    const FrontSize size(factor, front);
    const float* panel = factor.panels + factor.panel_begin[front];
    const int* rows = factor.rows + factor.row_begin[front];
    float* own = x + 4L * factor.pivot_begin[front];
    __builtin_memset(y, 0, sizeof(float) * size.ld);
    for (int i = 0; i < size.pivots; ++i) {
      for (int c = 0; c < 3; ++c) y[3 * i + c] = own[4 * i + c];
    }
    for (int i = 0; i < size.rows; ++i) {
      const float* at = x + 4L * rows[i];
      for (int c = 0; c < 3; ++c) y[size.pivot_rows + 3 * i + c] = at[c];
    }
    for (int j = (size.columns - 1) / block_columns * block_columns; j >= 0; j -= block_columns) {
      const int width = size.columns - j < block_columns ? size.columns - j : block_columns;
      const float* block = panel + j * size.ld + j;
      float* z = y + j;
      const int length = int(size.ld) - j;
      float head[block_columns] = {};
      int i = width;
      for (; i < length && i % CLOTH_FLOATS != 0; ++i) {
        for (int q = 0; q < width; ++q) head[q] += block[q * size.ld + i] * z[i];
      }
      Floats sum[block_columns];
      for (int q = 0; q < block_columns; ++q) sum[q] = Floats{};
      if (width == block_columns) {
        for (; i < length; i += CLOTH_FLOATS) {
          const Floats at = *reinterpret_cast<const Floats*>(z + i);
#pragma GCC unroll 16
          for (int q = 0; q < block_columns; ++q) {
            sum[q] += *reinterpret_cast<const Floats*>(block + q * size.ld + i) * at;
          }
        }
      } else {
        for (; i < length; i += CLOTH_FLOATS) {
          const Floats at = *reinterpret_cast<const Floats*>(z + i);
          for (int q = 0; q < width; ++q) sum[q] += *reinterpret_cast<const Floats*>(block + q * size.ld + i) * at;
        }
      }
      for (int q = width - 1; q >= 0; --q) {
        float value = z[q] - head[q];
        for (int l = 0; l < CLOTH_FLOATS; ++l) value -= sum[q][l];
        for (int r = q + 1; r < width; ++r) value -= block[q * size.ld + r] * z[r];
        z[q] = value / block[q * size.ld + q];
      }
    }
    for (int i = 0; i < size.pivots; ++i) {
      for (int c = 0; c < 3; ++c) own[4 * i + c] = y[3 * i + c];
    }
  }
}

}  // namespace
}  // namespace sim_core
