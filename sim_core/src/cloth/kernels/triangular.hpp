// Triangular solves with the fronts: L y = b from the leaves to the root, L^T x = y back.
#pragma once

#include "cloth/kernels/fronts.hpp"

namespace sim_core {
namespace {

constexpr int tile_vectors = tile_rows / CLOTH_FLOATS;

inline float sum_of(Floats v) {
  Node quarter[CLOTH_FLOATS / 4];
  *reinterpret_cast<Floats*>(quarter) = v;
  for (int q = 1; q < CLOTH_FLOATS / 4; ++q) quarter[0] += quarter[q];
  return (quarter[0][0] + quarter[0][1]) + (quarter[0][2] + quarter[0][3]);
}

// y += T z or y -= T z, of the rows of a tile.
template <int width, bool subtract, class Kept>
inline void add_tile(const Kept* tile, const float* z, float* y) {
  for (int v = 0; v < tile_vectors; ++v) {
    Floats* at = reinterpret_cast<Floats*>(y + CLOTH_FLOATS * v);
    Floats sum = *at, other{};
#pragma GCC unroll 12
    for (int q = 0; q < width; ++q) {
      const Floats part = wide(tile + q * tile_rows + CLOTH_FLOATS * v) * z[q];
      if (q % 2 == 0) {
        sum = subtract ? sum - part : sum + part;
      } else {
        other = subtract ? other - part : other + part;
      }
    }
    *at = sum + other;
  }
}

// sum += T^T y.
template <int width, class Kept>
inline void add_transposed(const Kept* tile, const float* y, Floats* sum) {
  for (int v = 0; v < tile_vectors; ++v) {
    const Floats at = *reinterpret_cast<const Floats*>(y + CLOTH_FLOATS * v);
#pragma GCC unroll 12
    for (int q = 0; q < width; ++q) {
      sum[q] += wide(tile + q * tile_rows + CLOTH_FLOATS * v) * at;
    }
  }
}

// A block of columns whose own rows begin at y: they are solved for, and leave the `below` rows
// after them.
template <int width, class Kept>
inline void forward(const Kept* tile, float* y, int below) {
  float z[tile_rows];
  for (int v = 0; v < tile_vectors; ++v) reinterpret_cast<Floats*>(z)[v] = Floats{};
  add_tile<width, false>(tile, y, z);
  for (int q = 0; q < width; ++q) y[q] = z[q];
  tile += width * tile_rows;
  for (int i = 0; i < below; i += tile_rows, tile += width * tile_rows)
    add_tile<width, true>(tile, z, y + width + i);
}

template <int width, class Kept>
inline void backward(const Kept* tile, float* y, int below) {
  Floats sum[width];
  for (int q = 0; q < width; ++q) sum[q] = Floats{};
  const Kept* other = tile + width * tile_rows;
  for (int i = 0; i < below; i += tile_rows, other += width * tile_rows) {
    add_transposed<width>(other, y + width + i, sum);
  }
  float z[tile_rows];
  for (int v = 0; v < tile_vectors; ++v) reinterpret_cast<Floats*>(z)[v] = Floats{};
  for (int q = 0; q < width; ++q) z[q] = y[q] - sum_of(sum[q]);
  for (int q = 0; q < width; ++q) sum[q] = Floats{};
  add_transposed<width>(tile, z, sum);
  for (int q = 0; q < width; ++q) y[q] = sum_of(sum[q]);
}

// Calls with the width of a block, that of one to four nodes, as a constant.
template <class Call>
inline void with_width(int width, const Call& call) {
  if (width == 12) return call.template operator()<12>();
  if (width == 9) return call.template operator()<9>();
  if (width == 6) return call.template operator()<6>();
  call.template operator()<3>();
}

// Copies the components of nodes from fours to threes, and back.
inline void gather(const float* nodes, int count, float* packed) {
  for (int i = 0; i < count; ++i) {
    for (int c = 0; c < 3; ++c) packed[3 * i + c] = nodes[4 * i + c];
  }
}

inline void scatter(const float* packed, int count, float* nodes) {
  for (int i = 0; i < count; ++i) {
    for (int c = 0; c < 3; ++c) nodes[4 * i + c] = packed[3 * i + c];
  }
}

inline int width_at(const FrontSize& size, int column) {
  return size.columns - column < tile_columns ? size.columns - column : tile_columns;
}

template <class Kept>
inline void forward_front(const Factor& factor, int front, float* x) {
  const FrontSize size(factor, front);
  const Kept* tile = static_cast<const Kept*>(factor.tiles) + factor.tile_begin[front];
  const int* rows = factor.rows + factor.row_begin[front];
  const int height = size.columns + 3 * size.rows;
  float* y = factor.local;
  float* pivots = x + 4L * factor.pivot_begin[front];
  gather(pivots, size.pivots, y);
  __builtin_memset(y + size.columns, 0, sizeof(float) * (3 * size.rows + tile_rows));
  for (int j = 0; j < size.columns; j += tile_columns) {
    const int width = width_at(size, j), below = height - j - width;
    with_width(width, [&]<int w>() { forward<w>(tile, y + j, below); });
    tile += tile_floats(width, below);
  }
  scatter(y, size.pivots, pivots);
  for (int i = 0; i < size.rows; ++i) {
    float* at = x + 4L * rows[i];
    for (int c = 0; c < 3; ++c) at[c] += y[size.columns + 3 * i + c];
  }
}

template <class Kept>
inline void backward_front(const Factor& factor, int front, float* x) {
  const FrontSize size(factor, front);
  const Kept* tile = static_cast<const Kept*>(factor.tiles) + factor.tile_begin[front + 1];
  const int* rows = factor.rows + factor.row_begin[front];
  const int height = size.columns + 3 * size.rows;
  float* y = factor.local;
  float* pivots = x + 4L * factor.pivot_begin[front];
  gather(pivots, size.pivots, y);
  for (int i = 0; i < size.rows; ++i) {
    const float* at = x + 4L * rows[i];
    for (int c = 0; c < 3; ++c) y[size.columns + 3 * i + c] = at[c];
  }
  __builtin_memset(y + height, 0, sizeof(float) * tile_rows);
  for (int j = (size.columns - 1) / tile_columns * tile_columns; j >= 0; j -= tile_columns) {
    const int width = width_at(size, j), below = height - j - width;
    tile -= tile_floats(width, below);
    with_width(width, [&]<int w>() { backward<w>(tile, y + j, below); });
  }
  scatter(y, size.pivots, pivots);
}

// In the factor's own order of nodes.
template <class Kept>
void solve_in_order(const Factor& factor, int nodes, const float* b, float* x) {
  if (x != b) __builtin_memcpy(x, b, 16L * nodes);
  for (int front = 0; front < factor.fronts; ++front) forward_front<Kept>(factor, front, x);
  for (int front = factor.fronts - 1; front >= 0; --front) backward_front<Kept>(factor, front, x);
}

// x = K^-1 b; `x` may be `b`.
void solve(const Factor& factor, int nodes, const float* b, float* x) {
  const auto solve_kept = factor.half ? solve_in_order<Half> : solve_in_order<float>;
  if (!factor.order) return solve_kept(factor, nodes, b, x);
  const Node* from = reinterpret_cast<const Node*>(b);
  Node *ordered = reinterpret_cast<Node*>(factor.ordered), *to = reinterpret_cast<Node*>(x);
  for (int i = 0; i < nodes; ++i) ordered[i] = from[factor.order[i]];
  solve_kept(factor, nodes, factor.ordered, factor.ordered);
  for (int i = 0; i < nodes; ++i) to[factor.order[i]] = ordered[i];
}

}  // namespace
}  // namespace sim_core
