// The multifrontal Cholesky factor [Duff & Reid 1983]: K = L L^T, front after front, children before parents.
#pragma once

#include "cloth/kernels/dense.hpp"

namespace sim_core {
namespace {

// Sizes of a front in floats. Pivot rows are padded apart from the others, so that both begin on a vector.
struct FrontSize {
  int pivots, rows;  // nodes
  int columns, pivot_rows, other_rows;
  long ld;

  FrontSize(const Factor& factor, int front)
      : pivots(factor.pivot_begin[front + 1] - factor.pivot_begin[front]),
        rows(factor.row_begin[front + 1] - factor.row_begin[front]),
        columns(3 * pivots),
        pivot_rows(padded(columns)),
        other_rows(padded(3 * rows)),
        ld(pivot_rows + other_rows) {}

  long place(int node) const { return node < pivots ? 3L * node : pivot_rows + 3L * (node - pivots); }
};

void factor(const Factor& factor, const ClothMatrix& matrix, const FactorDiagonal& diagonal) {
  // The stack holds the updates of fronts that wait for their parents; `top` is its end.
  long top = 0;
  int waiting = 0;
  for (int front = 0; front < factor.fronts; ++front) {
    const FrontSize size(factor, front);
    float* panel = factor.panels + factor.panel_begin[front];
    const long ldu = size.other_rows;
    const long update_size = ldu * (3L * size.rows + 6);
    float* update = factor.stack + top;
    __builtin_memset(panel, 0, sizeof(float) * size.ld * size.columns);
    __builtin_memset(update, 0, sizeof(float) * update_size);
    const int pivot0 = factor.pivot_begin[front];
    for (int i = 0; i < size.pivots; ++i) {
      const float* own = diagonal.added + 6L * (pivot0 + i);
      const float mass = matrix.diagonal[pivot0 + i];
      float* at = panel + 3L * i * size.ld + 3L * i;
      at[0] += own[0] + mass;
      at[1] += own[1];
      at[2] += own[2];
      at += size.ld;
      at[1] += own[3] + mass;
      at[2] += own[4];
      at += size.ld;
      at[2] += own[5] + mass;
    }
    for (long e = factor.entry_begin[front]; e < factor.entry_begin[front + 1]; ++e) {
      const float scalar = matrix.bending[factor.entry_slot[e]];
      float* at = panel + 3L * factor.entry_column[e] * size.ld + size.place(factor.entry_row[e]);
      at[0] += scalar;
      at[size.ld + 1] += scalar;
      at[2 * size.ld + 2] += scalar;
      if (factor.entry_block[e] >= 0) {
        const float* block = matrix.membrane + 12L * factor.entry_block[e];
        for (int c = 0; c < 3; ++c) {
          for (int r = 0; r < 3; ++r) at[c * size.ld + r] += block[4 * c + r];
        }
      }
    }
    for (int child = 0; child < factor.children[front]; ++child) {
      const int which = waiting - factor.children[front] + child, from = factor.waiting[which];
      const FrontSize below(factor, from);
      const float* source = factor.stack + factor.starts[which];
      const int* map = factor.parent_row + factor.row_begin[from];
      for (int j = 0; j < below.rows; ++j) {
        const bool pivot = map[j] < size.pivots;
        const long ld = pivot ? size.ld : ldu;
        float* column =
            pivot ? panel + 3L * map[j] * size.ld : update + 3L * (map[j] - size.pivots) * ldu - size.pivot_rows;
        for (int i = j; i < below.rows; ++i) {
          const float* block = source + 3L * j * below.other_rows + 3L * i;
          float* at = column + size.place(map[i]);
          for (int c = 0; c < 3; ++c) {
            for (int r = 0; r < 3; ++r) at[c * ld + r] += block[c * below.other_rows + r];
          }
        }
      }
    }
    for (int j = 0; j < size.columns; j += block_columns) {
      const int width = size.columns - j < block_columns ? size.columns - j : block_columns;
      float* block = panel + j * size.ld + j;
      factor_columns(block, size.ld, width, int(size.ld) - j);
      const int rest = size.columns - j - width;
      if (rest > 0) {
        subtract_square(block + width, size.ld, width, block + width * size.ld + width, size.ld,
                        int(size.ld) - j - width, rest);
      }
    }
    if (size.rows > 0) {
      subtract_square(panel + size.pivot_rows, size.ld, size.columns, update, ldu, size.other_rows, 3 * size.rows);
    }
    if (factor.children[front] > 0) {
      waiting -= factor.children[front];
      __builtin_memmove(factor.stack + factor.starts[waiting], update, sizeof(float) * update_size);
      top = factor.starts[waiting];
    }
    if (size.rows > 0) {
      factor.starts[waiting] = top;
      factor.waiting[waiting] = front;
      ++waiting;
      top += (update_size + 15) / 16 * 16;
    }
  }
}

}  // namespace
}  // namespace sim_core
