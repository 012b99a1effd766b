// Products and triangular solves with several vectors at once, which read the matrix and the factor
// once for all of them.
#pragma once

#include "cloth/kernels/krylov.hpp"

namespace sim_core {
namespace {

template <int count>
inline void apply_rows_to(const ClothMatrix& matrix, const int* mode, const float* const* x,
                          float* const* y) {
  const auto in = [&](int p, int i) { return *(reinterpret_cast<const Node*>(x[p]) + i); };
  for (int i = 0; i < matrix.nodes; ++i) {
    Node sum[count];
    const bool sticks = mode[i] == contact_stick;
    for (int p = 0; p < count; ++p)
      sum[p] = sticks ? Node{} : spread(matrix.diagonal[i]) * in(p, i);
    const int last = sticks ? matrix.bending_begin[i] : matrix.bending_begin[i + 1];
    for (int e = matrix.bending_begin[i]; e < last; ++e) {
      const Node scalar = spread(matrix.bending[e]);
      for (int p = 0; p < count; ++p) sum[p] += scalar * in(p, matrix.bending_node[e]);
    }
    const int last_block = sticks ? matrix.membrane_begin[i] : matrix.membrane_begin[i + 1];
    for (int b = matrix.membrane_begin[i]; b < last_block; ++b) {
      const Node* column = reinterpret_cast<const Node*>(matrix.membrane + 12L * b);
      for (int p = 0; p < count; ++p) {
        const Node v = in(p, matrix.membrane_node[b]);
        sum[p] += column[0] * spread(v[0]) + column[1] * spread(v[1]) + column[2] * spread(v[2]);
      }
    }
    for (int p = 0; p < count; ++p) *(reinterpret_cast<Node*>(y[p]) + i) = sum[p];
  }
}

template <int width, int count, class Number>
inline void forward_block(const Number* tile, float* const* y, int at, int below) {
  float z[count][tile_rows];
  const auto multiply = [&](auto factors, auto result) {
    for (int v = 0; v < tile_vectors; ++v) {
      Floats sum[count];
      for (int p = 0; p < count; ++p) sum[p] = Floats{};
#pragma GCC unroll 12
      for (int q = 0; q < width; ++q) {
        const Floats part = wide(tile + q * tile_rows + CLOTH_FLOATS * v);
        for (int p = 0; p < count; ++p) sum[p] += part * factors(p)[q];
      }
      for (int p = 0; p < count; ++p) result(p, CLOTH_FLOATS * v, sum[p]);
    }
    tile += width * tile_rows;
  };
  multiply([&](int p) { return y[p] + at; },
           [&](int p, int row, Floats sum) { keep(sum, z[p] + row); });
  for (int p = 0; p < count; ++p) __builtin_memcpy(y[p] + at, z[p], sizeof(float) * width);
  for (int i = 0; i < below; i += tile_rows) {
    multiply([&](int p) -> const float* { return z[p]; },
             [&](int p, int row, Floats sum) {
               float* to = y[p] + at + width + i + row;
               keep(wide(to) - sum, to);
             });
  }
}

// Sums of three columns for each vector, which the registers hold.
template <int count>
struct ColumnSums {
  Floats of[3][count];

  void clear() {
    for (int k = 0; k < 3; ++k) {
      for (int p = 0; p < count; ++p) of[k][p] = Floats{};
    }
  }
  // Adds the products of the columns of a tile with the rows of each vector.
  template <class Number, class Rows>
  void add(const Number* tile, const Rows& rows) {
    for (int v = 0; v < tile_vectors; ++v) {
      Floats value[count];
      for (int p = 0; p < count; ++p) value[p] = wide(rows(p) + CLOTH_FLOATS * v);
      for (int k = 0; k < 3; ++k) {
        const Floats column = wide(tile + k * tile_rows + CLOTH_FLOATS * v);
        for (int p = 0; p < count; ++p) of[k][p] += column * value[p];
      }
    }
  }
};

template <int width, int count, class Number>
inline void backward_block(const Number* tile, float* const* y, int at, int below) {
  float z[count][tile_rows] = {};
  const auto multiply = [&](const Number* from, int rows, auto vector, auto result) {
    for (int q = 0; q < width; q += 3) {
      ColumnSums<count> sums;
      sums.clear();
      const Number* part = from + q * tile_rows;
      for (int i = 0; i < rows; i += tile_rows, part += width * tile_rows)
        sums.add(part, [&](int p) { return vector(p) + i; });
      for (int k = 0; k < 3; ++k) {
        for (int p = 0; p < count; ++p) result(p, q + k, sum_of(sums.of[k][p]));
      }
    }
  };
  multiply(
      tile + width * tile_rows, below, [&](int p) { return y[p] + at + width; },
      [&](int p, int q, float sum) { z[p][q] = y[p][at + q] - sum; });
  multiply(
      tile, tile_rows, [&](int p) -> const float* { return z[p]; },
      [&](int p, int q, float sum) { y[p][at + q] = sum; });
}

// The right-hand sides of one front, one after the other in the factor's memory for them.
template <int count>
struct FrontVectors {
  float* y[count];

  explicit FrontVectors(const Factor& factor) {
    for (int p = 0; p < count; ++p) y[p] = factor.local + p * factor.local_floats;
  }
};

template <int count, class Number>
inline void forward_front_of(const Factor& factor, int front, float* const* x) {
  const FrontSize size(factor, front);
  const Number* tile = static_cast<const Number*>(factor.tiles) + factor.tile_begin[front];
  const int* rows = factor.rows + factor.row_begin[front];
  const int height = size.columns + 3 * size.rows;
  const FrontVectors<count> local(factor);
  const long first = 4L * factor.pivot_begin[front];
  for (int p = 0; p < count; ++p) {
    gather(x[p] + first, size.pivots, local.y[p]);
    __builtin_memset(local.y[p] + size.columns, 0, sizeof(float) * (3 * size.rows + tile_rows));
  }
  for (int j = 0; j < size.columns; j += tile_columns) {
    const int width = width_at(size, j), below = height - j - width;
    with_width(width, [&]<int w>() { forward_block<w, count>(tile, local.y, j, below); });
    tile += tile_floats(width, below);
  }
  for (int p = 0; p < count; ++p) {
    scatter(local.y[p], size.pivots, x[p] + first);
    for (int i = 0; i < size.rows; ++i) {
      float* at = x[p] + 4L * rows[i];
      for (int c = 0; c < 3; ++c) at[c] += local.y[p][size.columns + 3 * i + c];
    }
  }
}

template <int count, class Number>
inline void backward_front_of(const Factor& factor, int front, float* const* x) {
  const FrontSize size(factor, front);
  const Number* tile = static_cast<const Number*>(factor.tiles) + factor.tile_begin[front + 1];
  const int* rows = factor.rows + factor.row_begin[front];
  const int height = size.columns + 3 * size.rows;
  const FrontVectors<count> local(factor);
  const long first = 4L * factor.pivot_begin[front];
  for (int p = 0; p < count; ++p) {
    gather(x[p] + first, size.pivots, local.y[p]);
    for (int i = 0; i < size.rows; ++i) {
      const float* at = x[p] + 4L * rows[i];
      for (int c = 0; c < 3; ++c) local.y[p][size.columns + 3 * i + c] = at[c];
    }
    __builtin_memset(local.y[p] + height, 0, sizeof(float) * tile_rows);
  }
  for (int j = (size.columns - 1) / tile_columns * tile_columns; j >= 0; j -= tile_columns) {
    const int width = width_at(size, j), below = height - j - width;
    tile -= tile_floats(width, below);
    with_width(width, [&]<int w>() { backward_block<w, count>(tile, local.y, j, below); });
  }
  for (int p = 0; p < count; ++p) scatter(local.y[p], size.pivots, x[p] + first);
}

template <int count, class Number>
void solve_for(const Factor& factor, float* const* x) {
  for (int front = 0; front < factor.fronts; ++front)
    forward_front_of<count, Number>(factor, front, x);
  for (int front = factor.fronts - 1; front >= 0; --front)
    backward_front_of<count, Number>(factor, front, x);
}

// x = K^-1 b of each vector.
template <int count>
void precondition(const Factor& factor, int nodes, const float* const* b, float* const* x) {
  float* in_order[count];
  for (int p = 0; p < count; ++p) {
    in_order[p] = factor.order ? factor.ordered + 4L * nodes * p : x[p];
    const Node* from = reinterpret_cast<const Node*>(b[p]);
    Node* to = reinterpret_cast<Node*>(in_order[p]);
    for (int i = 0; i < nodes; ++i) to[i] = from[factor.order ? factor.order[i] : i];
  }
  factor.half ? solve_for<count, Half>(factor, in_order)
              : solve_for<count, float>(factor, in_order);
  for (int p = 0; factor.order && p < count; ++p) {
    const Node* from = reinterpret_cast<const Node*>(in_order[p]);
    for (int i = 0; i < nodes; ++i) reinterpret_cast<Node*>(x[p])[factor.order[i]] = from[i];
  }
}

template <int count>
void apply_contact_to(const ClothMatrix& matrix, const ContactRows& contact, const float* const* v,
                      float* const* y) {
  apply_rows_to<count>(matrix, contact.mode, v, y);
  for (int p = 0; p < count; ++p) {
    add_folds(*matrix.folds, reinterpret_cast<const Node*>(v[p]), reinterpret_cast<Node*>(y[p]));
    if (matrix.pairs)
      add_pairs(*matrix.pairs, reinterpret_cast<const Node*>(v[p]), reinterpret_cast<Node*>(y[p]));
    follow_friction(matrix, contact, v[p], y[p]);
  }
}

// Calls with the count of vectors of each group, as a constant, and the first of them.
template <class Call>
inline void in_groups(int count, const Call& call) {
  int first = 0;
  for (; count - first >= 4; first += 4) call.template operator()<4>(first);
  if (count - first == 3) call.template operator()<3>(first);
  if (count - first == 2) call.template operator()<2>(first);
  if (count - first == 1) call.template operator()<1>(first);
}

}  // namespace
}  // namespace sim_core
