// The multifrontal Cholesky factor [Duff & Reid 1983]: K = L L^T, front after front, children
// before parents. Its dense pieces come first.
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
    for (int v = 0; v < vectors; ++v)
      left[v] = *reinterpret_cast<const Floats*>(a + p * ld + CLOTH_FLOATS * v);
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
inline void multiply_column(const float* a, const float* b, long ld, int depth, float* c, long ldc,
                            int rows) {
  int i = 0;
  // Sixteen wide registers hold 2 x 6 sums, thirty-two 4 x 6.
  for (; CLOTH_FLOATS == 16 && i + 4 * CLOTH_FLOATS <= rows; i += 4 * CLOTH_FLOATS) {
    multiply_tile<4, columns, set>(a + i, b, ld, depth, c + i, ldc);
  }
  for (; i + 2 * CLOTH_FLOATS <= rows; i += 2 * CLOTH_FLOATS) {
    multiply_tile<2, columns, set>(a + i, b, ld, depth, c + i, ldc);
  }
  for (; i < rows; i += CLOTH_FLOATS)
    multiply_tile<1, columns, set>(a + i, b, ld, depth, c + i, ldc);
}

// Lower part of C = -A A^T, a square of `columns`, a multiple of 3; A has `rows` >= columns,
// padded. Tiles that touch the diagonal are whole.
inline void negative_square(const float* a, long ld, int depth, float* c, long ldc, int rows,
                            int columns) {
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

// The triangle of `width` columns on the diagonal, and the inverses of its pivots.
struct DiagonalBlock {
  float l[tile_columns][tile_columns], inverse[tile_columns];
};

inline void factor_diagonal(const float* panel, long ld, int width, DiagonalBlock& block) {
  auto& l = block.l;
  for (int j = 0; j < width; ++j) {
    float pivot = panel[j * ld + j];
    const float diagonal = pivot;
    for (int q = 0; q < j; ++q) pivot -= l[j][q] * l[j][q];
    if (!(pivot > 1e-6f * diagonal))
      pivot = diagonal > 0.0f ? 1e-6f * diagonal : 1.0f;  // rounding: the factor may be inexact
    l[j][j] = __builtin_sqrtf(pivot);
    block.inverse[j] = 1.0f / l[j][j];
    for (int i = j + 1; i < width; ++i) {
      float sum = panel[j * ld + i];
      for (int q = 0; q < j; ++q) sum -= l[i][q] * l[j][q];
      l[i][j] = sum * block.inverse[j];
    }
  }
}

// Rows from `begin` to `end`, in whole vectors and one by one.
inline void factor_vectors(float* panel, long ld, int width, int begin, int end,
                           const DiagonalBlock& block) {
  for (int i = begin; i < end; i += CLOTH_FLOATS) {
    Floats v[tile_columns];
    for (int j = 0; j < width; ++j) {
      Floats sum = *reinterpret_cast<const Floats*>(panel + j * ld + i);
      for (int q = 0; q < j; ++q) sum -= v[q] * block.l[j][q];
      v[j] = sum * block.inverse[j];
      *reinterpret_cast<Floats*>(panel + j * ld + i) = v[j];
    }
  }
}

inline void factor_rows(float* panel, long ld, int width, int begin, int end,
                        const DiagonalBlock& block) {
  for (int i = begin; i < end; ++i) {
    for (int j = 0; j < width; ++j) {
      float sum = panel[j * ld + i];
      for (int q = 0; q < j; ++q) sum -= panel[q * ld + i] * block.l[j][q];
      panel[j * ld + i] = sum * block.inverse[j];
    }
  }
}

// Factor `width` columns of a panel from its diagonal down to `rows`, all earlier columns being
// subtracted already.
inline void factor_columns(float* panel, long ld, int width, int rows) {
  DiagonalBlock block;
  factor_diagonal(panel, ld, width, block);
  const int below = (width + CLOTH_FLOATS - 1) / CLOTH_FLOATS * CLOTH_FLOATS;
  factor_vectors(panel, ld, width, below, rows, block);
  // Rows between the block and the first whole vector.
  factor_rows(panel, ld, width, width, below < rows ? below : rows, block);
  for (int j = 0; j < width; ++j) {
    for (int i = j; i < width; ++i) panel[j * ld + i] = block.l[i][j];
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

// Sizes of a front in floats. Pivot rows are padded apart from the others, so that both begin on a
// vector.
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

  long place(int node) const {
    return node < pivots ? 3L * node : pivot_rows + 3L * (node - pivots);
  }
};

// Reads and writes whole vectors: what lies behind `count` is read, and written as it was.
inline void add_floats(const float* from, float* to, int count) {
  int i = 0;
  for (; i + CLOTH_FLOATS <= count; i += CLOTH_FLOATS) {
    *reinterpret_cast<Floats*>(to + i) += *reinterpret_cast<const Floats*>(from + i);
  }
  if (i == count) return;
  const Integers inside = lane_numbers() < count - i;
  *reinterpret_cast<Floats*>(to + i) +=
      Floats(Integers(*reinterpret_cast<const Floats*>(from + i)) & inside);
}

template <class Kept>
inline void keep_rows(const float* from, Kept* to) {
  for (int v = 0; v < tile_rows; v += CLOTH_FLOATS) keep(wide(from + v), to + v);
}

// Rows below a block of columns, which stand in two parts of the panel: pivot rows, and the others.
struct RowsBelow {
  const float *upper, *lower;  // such that row i of the first column is upper[i] or lower[i]
  int pivot_rows, end;

  float at(long column_offset, int i) const {
    if (i < pivot_rows) return upper[column_offset + i];
    return i < end ? lower[column_offset + i] : 0.0f;
  }
};

// A tile of rows of both parts, or of the last ones: padded with zeros.
template <class Kept>
inline void keep_mixed_tile(const RowsBelow& rows, long ld, int i, int width, Kept* tile) {
  float padded[tile_rows];
  for (int q = 0; q < width; ++q, tile += tile_rows) {
    for (int r = 0; r < tile_rows; ++r) padded[r] = rows.at(q * ld, i + r);
    keep_rows(padded, tile);
  }
}

// Writes the tiles of a block of columns that is done.
template <class Kept>
inline void keep_tiles(const Factor& factor, const FrontSize& size, int j, int width, long begin) {
  Kept* tile = static_cast<Kept*>(factor.tiles) + begin;
  const int first = j + width, columns_left = size.columns - first,
            end = columns_left + 3 * size.rows;
  float inverse[tile_columns * tile_rows] = {};
  invert_triangle(factor.panel + j * size.ld + j, size.ld, width, inverse);
  for (int q = 0; q < width; ++q, tile += tile_rows) keep_rows(inverse + q * tile_rows, tile);
  // Pivot rows and other rows lie apart in the panel.
  const RowsBelow rows{factor.panel + j * size.ld + first,
                       factor.panel + j * size.ld + size.pivot_rows - columns_left, columns_left,
                       end};
  for (int i = 0; i < end; i += tile_rows, tile += width * tile_rows) {
    const bool is_upper = i + tile_rows <= columns_left;
    if (!is_upper && (i < columns_left || i + tile_rows > end)) {
      keep_mixed_tile(rows, size.ld, i, width, tile);
      continue;
    }
    const float* from = (is_upper ? rows.upper : rows.lower) + i;
    for (int q = 0; q < width; ++q) keep_rows(from + q * size.ld, tile + q * tile_rows);
  }
}

// Adds what waits of a child to those columns of its parent that are pivots, or to the others;
// column j of the parent begins at parent + j ld.
inline void add_update(const Factor& factor, int child, const FrontSize& size, bool pivots,
                       float* parent, long ld) {
  const FrontSize below(factor, child);
  const float* update = factor.updates + factor.update_begin[child];
  const FrontRun* end = factor.runs + factor.run_begin[child + 1];
  for (const FrontRun* run = factor.runs + factor.run_begin[child]; run < end; ++run) {
    if ((run->place < size.pivots) != pivots) continue;
    for (int j = 0; j < 3 * run->count; ++j) {
      const float* from = update + (3L * run->row + j) * below.other_rows;
      float* to = parent + (size.place(run->place) + j) * ld;
      int skip = j / 3 * 3;  // the lower triangle is all there is
      for (const FrontRun* rows = run; rows < end; ++rows, skip = 0) {
        add_floats(from + 3L * rows->row + skip, to + size.place(rows->place) + skip,
                   3 * rows->count - skip);
      }
    }
  }
}

// Writes what the matrix and `added` have of a front into the panel.
inline void load_front(const Factor& factor, const ClothMatrix& matrix, const float* added,
                       int front, const FrontSize& size) {
  float* panel = factor.panel;
  __builtin_memset(panel, 0, sizeof(float) * size.ld * size.columns);
  const int pivot0 = factor.pivot_begin[front];
  for (int i = 0; i < size.pivots; ++i) {
    const float* addend = added + 6L * (pivot0 + i);
    const float mass = matrix.diagonal[pivot0 + i];
    float* at = panel + 3L * i * size.ld + 3L * i;
    for (int c = 0; c < 3; ++c, at += size.ld) {
      at[c] += mass;
      for (int r = c; r < 3; ++r) at[r] += *addend++;
    }
  }
  for (long e = factor.entry_begin[front]; e < factor.entry_begin[front + 1]; ++e) {
    const float scalar = matrix.bending[factor.entry_slot[e]];
    float* at = panel + 3L * factor.entry_column[e] * size.ld + size.place(factor.entry_row[e]);
    for (int c = 0; c < 3; ++c) at[c * (size.ld + 1)] += scalar;
    if (factor.entry_block[e] < 0) continue;
    const float* block = matrix.membrane + 12L * factor.entry_block[e];
    for (int c = 0; c < 3; ++c) {
      for (int r = 0; r < 3; ++r) at[c * size.ld + r] += block[4 * c + r];
    }
  }
}

// Factors the columns of the panel, and writes their tiles.
inline void factor_panel(const Factor& factor, int front, const FrontSize& size) {
  float* panel = factor.panel;
  long tile = factor.tile_begin[front];
  for (int j = 0; j < size.columns; j += tile_columns) {
    const int width = size.columns - j < tile_columns ? size.columns - j : tile_columns;
    subtract_columns(panel, size.ld, j, width, int(size.ld));
    factor_columns(panel + j * size.ld + j, size.ld, width, int(size.ld) - j);
    factor.half ? keep_tiles<Half>(factor, size, j, width, tile)
                : keep_tiles<float>(factor, size, j, width, tile);
    tile += tile_floats(width, size.columns - j - width + 3 * size.rows);
  }
}

// Leaves for the parent what the front subtracts from its rows, and what waits of its children.
inline void leave_update(const Factor& factor, int front, const FrontSize& size) {
  if (size.rows == 0) return;
  const long ld = size.other_rows;
  float* update = factor.updates + factor.update_begin[front];
  negative_square(factor.panel + size.pivot_rows, size.ld, size.columns, update, ld,
                  size.other_rows, 3 * size.rows);
  for (int c = factor.child_begin[front]; c < factor.child_begin[front + 1]; ++c) {
    add_update(factor, factor.children[c], size, false, update - (ld + 1) * size.pivot_rows, ld);
  }
}

void factor(const Factor& factor, const ClothMatrix& matrix, const float* added) {
  const FlushTiny flush;
  for (int front = 0; front < factor.fronts; ++front) {
    if (!factor.due[front]) continue;
    const FrontSize size(factor, front);
    load_front(factor, matrix, added, front, size);
    for (int c = factor.child_begin[front]; c < factor.child_begin[front + 1]; ++c)
      add_update(factor, factor.children[c], size, true, factor.panel, size.ld);
    factor_panel(factor, front, size);
    leave_update(factor, front, size);
  }
}

}  // namespace
}  // namespace sim_core
