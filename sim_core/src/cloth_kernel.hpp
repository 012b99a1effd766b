// The arithmetic of cloth: energies, matrix, Cholesky factor, Krylov method. Compiled once per instruction set with
// CLOTH_FLOATS floats in a vector; see lanes.hpp on why all names are in an unnamed namespace.
//
// Sums are taken in an order that depends on CLOTH_FLOATS alone: equal machines give equal bits.
#pragma once

#include "cloth_problem.hpp"

namespace sim_core {
namespace {

typedef float Floats __attribute__((vector_size(4 * CLOTH_FLOATS), aligned(4), may_alias));
typedef float Node __attribute__((vector_size(16), aligned(16), may_alias));
typedef double NodeD __attribute__((vector_size(32), aligned(32), may_alias));
typedef double Lane __attribute__((vector_size(8 * membrane_lanes), aligned(64), may_alias));

inline Node spread(float s) { return Node{s, s, s, s}; }
inline NodeD spread(double s) { return NodeD{s, s, s, s}; }
inline float dot3(Node a, Node b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
inline double dot3(NodeD a, NodeD b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline Lane root(Lane a) {
  Lane r;
  for (int l = 0; l < membrane_lanes; ++l) r[l] = __builtin_sqrt(a[l]);
  return r;
}

// --- membrane ---------------------------------------------------------------------------------------------------

// K_ij of the membrane, i and j two of a triangle's nodes: sum over the columns f of the deformation gradient.
struct Pair {
  Lane m00, m01, m10, m11, geometric;
};

inline void add_block(float* blocks, int slot, const double (&block)[3][3], double sign, bool transposed) {
  if (slot < 0) return;
  float* target = blocks + 12L * slot;
  for (int c = 0; c < 3; ++c) {
    for (int r = 0; r < 3; ++r) target[4 * c + r] += float(sign * (transposed ? block[c][r] : block[r][c]));
  }
}

// Green's strain G = (F^T F - 1)/2 and W = A (k0 G00^2/2 + k1 G00 G11 + k2 G11^2/2 + k3 G01^2) [Wang et al. 2011]. If
// `project`, the matrix has the positive part of the stress in place of the stress [Teran et al. 2005] and is positive
// semi-definite.
template <bool matrix>
double membrane_groups(const MembraneData& data, const double* x, double* gradient, float* blocks, bool project) {
  constexpr int W = membrane_lanes;
  Lane energy{};
  for (int group = 0; group < data.groups; ++group) {
    const int* nodes = data.nodes + 3L * W * group;
    Lane p[3][3];
    for (int a = 0; a < 3; ++a) {
      for (int l = 0; l < W; ++l) {
        const double* at = x + 4L * nodes[W * a + l];
        for (int c = 0; c < 3; ++c) p[a][c][l] = at[c];
      }
    }
    const Lane* shape = reinterpret_cast<const Lane*>(data.shape + 4L * W * group);
    const Lane* k = reinterpret_cast<const Lane*>(data.stiffness + 4L * W * group);
    const Lane area = *reinterpret_cast<const Lane*>(data.area + 1L * W * group);
    const Lane n[3][2] = {{-shape[0] - shape[2], -shape[1] - shape[3]}, {shape[0], shape[1]}, {shape[2], shape[3]}};
    Lane f[2][3];
    for (int c = 0; c < 3; ++c) {
      const Lane u = p[1][c] - p[0][c], v = p[2][c] - p[0][c];
      f[0][c] = u * shape[0] + v * shape[2];
      f[1][c] = u * shape[1] + v * shape[3];
    }
    const Lane g00 = 0.5 * (f[0][0] * f[0][0] + f[0][1] * f[0][1] + f[0][2] * f[0][2] - 1.0);
    const Lane g11 = 0.5 * (f[1][0] * f[1][0] + f[1][1] * f[1][1] + f[1][2] * f[1][2] - 1.0);
    const Lane g01 = 0.5 * (f[0][0] * f[1][0] + f[0][1] * f[1][1] + f[0][2] * f[1][2]);
    const Lane s00 = k[0] * g00 + k[1] * g11, s11 = k[1] * g00 + k[2] * g11, s01 = k[3] * g01;
    energy += area * (0.5 * k[0] * g00 * g00 + k[1] * g00 * g11 + 0.5 * k[2] * g11 * g11 + k[3] * g01 * g01);
    Lane force[3][3];
    for (int a = 0; a < 3; ++a) {
      const Lane u = area * (s00 * n[a][0] + s01 * n[a][1]), v = area * (s01 * n[a][0] + s11 * n[a][1]);
      for (int c = 0; c < 3; ++c) force[a][c] = f[0][c] * u + f[1][c] * v;
    }
    for (int a = 0; a < 3; ++a) {
      for (int l = 0; l < W; ++l) {
        double* at = gradient + 4L * nodes[W * a + l];
        for (int c = 0; c < 3; ++c) at[c] += force[a][c][l];
      }
    }
    if constexpr (matrix) {
      const Lane zero{};
      Lane t00 = area * s00, t11 = area * s11, t01 = area * s01;
      if (project) {
        const Lane mean = 0.5 * (s00 + s11), half = 0.5 * (s00 - s11);
        const Lane radius = root(half * half + s01 * s01) + 1e-30;
        const Lane big = mean + radius, small = mean - radius;
        const Lane big_plus = big > zero ? big : zero, small_plus = small > zero ? small : zero;
        const Lane middle = 0.5 * (big_plus + small_plus), spread_ratio = 0.5 * (big_plus - small_plus) / radius;
        t00 = area * (middle + spread_ratio * half);
        t11 = area * (middle - spread_ratio * half);
        t01 = area * spread_ratio * s01;
      }
      const Lane k0 = area * k[0], k1 = area * k[1], k2 = area * k[2], k3 = 0.5 * area * k[3];
      const int* slots = data.slots + 9L * W * group;
      constexpr int first[3] = {0, 0, 1}, second[3] = {1, 2, 2};
      for (int pair = 0; pair < 3; ++pair) {
        const Lane *a = n[first[pair]], *b = n[second[pair]];
        const Lane m00 = k0 * a[0] * b[0] + k3 * a[1] * b[1], m11 = k2 * a[1] * b[1] + k3 * a[0] * b[0];
        const Lane m01 = k1 * a[0] * b[1] + k3 * a[1] * b[0], m10 = k1 * a[1] * b[0] + k3 * a[0] * b[1];
        const Lane geometric = a[0] * (t00 * b[0] + t01 * b[1]) + a[1] * (t01 * b[0] + t11 * b[1]);
        Lane block[3][3];
        for (int r = 0; r < 3; ++r) {
          const Lane u = m00 * f[0][r] + m10 * f[1][r], v = m01 * f[0][r] + m11 * f[1][r];
          for (int c = 0; c < 3; ++c) block[r][c] = u * f[0][c] + v * f[1][c] + (r == c ? geometric : zero);
        }
        for (int l = 0; l < W; ++l) {
          double one[3][3];
          for (int r = 0; r < 3; ++r) {
            for (int c = 0; c < 3; ++c) one[r][c] = block[r][c][l];
          }
          const int* slot = slots + 9L * l;
          add_block(blocks, slot[2 * pair], one, 1.0, false);
          add_block(blocks, slot[2 * pair + 1], one, 1.0, true);
          // A translation costs nothing: rows add up to zero.
          add_block(blocks, slot[6 + first[pair]], one, -1.0, false);
          add_block(blocks, slot[6 + second[pair]], one, -1.0, true);
        }
      }
    }
  }
  double total = 0.0;
  for (int l = 0; l < W; ++l) total += energy[l];
  return total;
}

double membrane(const MembraneData& data, const double* x, double* gradient, float* blocks, bool project) {
  return blocks ? membrane_groups<true>(data, x, gradient, blocks, project)
                : membrane_groups<false>(data, x, gradient, nullptr, project);
}

// --- bending ----------------------------------------------------------------------------------------------------

// A fold by theta over the length h has s = h^2 |H|^2 = 4 sin^2(theta/2) where its energy should go as theta^2. The
// ratio r(s) = theta^2 / s turns the one into the other; beyond `fold_end` theta^2 goes on as a parabola in s.
struct Stiffening {
  double ratio, slope;  // r and dr/ds
};

constexpr double fold_series = 0.4, fold_end = 3.8;

inline Stiffening stiffening_of(double s) {
  if (s < fold_series) {
    // theta^2 = 2 sum_n s^n / (n^2 C(2n, n))
    constexpr double c[11] = {1.0,         1.0 / 12,     1.0 / 90,      1.0 / 560,     1.0 / 3150,    1.0 / 16632,
                              1.0 / 84084, 1.0 / 411840, 1.0 / 1969110, 1.0 / 9237800, 1.0 / 42678636};
    double ratio = c[10], slope = 0.0;
    for (int n = 9; n >= 0; --n) {
      slope = slope * s + ratio;
      ratio = ratio * s + c[n];
    }
    return {ratio, slope};
  }
  const double at = s < fold_end ? s : fold_end;
  const double theta = 2.0 * __builtin_asin(0.5 * __builtin_sqrt(at));
  const double sine = __builtin_sin(theta), cosine = __builtin_cos(theta);
  double value = theta * theta, first = theta / sine;
  if (s > fold_end) {
    const double second = (sine - theta * cosine) / (2.0 * sine * sine * sine), beyond = s - fold_end;
    value += beyond * (first + 0.5 * beyond * second);
    first += beyond * second;
  }
  return {value / s, (first - value / s) / s};
}

// W = A/2 r(s) H:D:H for each triangle; r D + (H:D:H) r' h^2 I, without the rank-one rest, goes into the matrix.
double bending(const BendingData& data, const double* x, double* gradient, float* stiffening) {
  double energy = 0.0;
  const double* d = data.rigidity;
  for (int t = 0; t < data.triangles; ++t) {
    const int begin = data.begin[t], end = data.begin[t + 1];
    NodeD h0{}, h1{}, h2{};
    for (int i = begin; i < end; ++i) {
      const NodeD at = *reinterpret_cast<const NodeD*>(x + 4L * data.nodes[i]);
      const double* w = data.weights + 4L * i;
      h0 += spread(w[0]) * at;
      h1 += spread(w[1]) * at;
      h2 += spread(w[2]) * at;
    }
    const NodeD m0 = spread(d[0]) * h0 + spread(d[1]) * h1 + spread(d[2]) * h2;
    const NodeD m1 = spread(d[1]) * h0 + spread(d[3]) * h1 + spread(d[4]) * h2;
    const NodeD m2 = spread(d[2]) * h0 + spread(d[4]) * h1 + spread(d[5]) * h2;
    const double q = dot3(m0, h0) + dot3(m1, h1) + dot3(m2, h2);
    const double s = data.spacing2[t] * (dot3(h0, h0) + dot3(h1, h1) + 0.5 * dot3(h2, h2));
    const Stiffening fold = stiffening_of(s);
    const double area = data.area[t], turn = q * fold.slope * data.spacing2[t];
    energy += 0.5 * area * fold.ratio * q;
    if (stiffening) {
      stiffening[2L * t] = float(fold.ratio);
      stiffening[2L * t + 1] = float(turn);
    }
    const NodeD r = spread(area * fold.ratio), u = spread(area * turn);
    const NodeD p0 = r * m0 + u * h0, p1 = r * m1 + u * h1, p2 = r * m2 + spread(0.5) * u * h2;
    for (int i = begin; i < end; ++i) {
      NodeD* at = reinterpret_cast<NodeD*>(gradient + 4L * data.nodes[i]);
      const double* w = data.weights + 4L * i;
      *at += spread(w[0]) * p0 + spread(w[1]) * p1 + spread(w[2]) * p2;
    }
  }
  return energy;
}

void bending_matrix(const BendingData& data, const float* stiffening, float* scalars) {
  const double* d = data.rigidity;
  for (int t = 0; t < data.triangles; ++t) {
    const int begin = data.begin[t], count = data.begin[t + 1] - begin;
    const double r = data.area[t] * stiffening[2L * t], u = data.area[t] * stiffening[2L * t + 1];
    const int* slot = data.slots + 2L * data.slot_begin[t];
    for (int i = 0; i < count; ++i) {
      const double* w = data.weights + 4L * (begin + i);
      const double c0 = r * (d[0] * w[0] + d[1] * w[1] + d[2] * w[2]) + u * w[0];
      const double c1 = r * (d[1] * w[0] + d[3] * w[1] + d[4] * w[2]) + u * w[1];
      const double c2 = r * (d[2] * w[0] + d[4] * w[1] + d[5] * w[2]) + 0.5 * u * w[2];
      for (int j = 0; j <= i; ++j, slot += 2) {
        if (slot[0] < 0) continue;
        const double* v = data.weights + 4L * (begin + j);
        const float value = float(c0 * v[0] + c1 * v[1] + c2 * v[2]);
        scalars[slot[0]] += value;
        if (slot[1] != slot[0]) scalars[slot[1]] += value;
      }
    }
  }
}

// --- matrix -----------------------------------------------------------------------------------------------------

void apply(const ClothMatrix& matrix, const float* x, float* y) {
  const Node* in = reinterpret_cast<const Node*>(x);
  Node* out = reinterpret_cast<Node*>(y);
  for (int i = 0; i < matrix.nodes; ++i) {
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
}

// --- Cholesky factor --------------------------------------------------------------------------------------------

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

// --- linear problem of contact ----------------------------------------------------------------------------------

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
  apply(matrix, v, y);
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
KrylovResult krylov(const ClothMatrix& matrix, const Factor& factor, const ContactRows& contact, const float* b,
                    float* x, float* work, int iterations, double tolerance) {
  const long count = 4L * matrix.nodes;
  float* basis = work;
  float* images = work + (krylov_max + 1) * count;
  double h[krylov_max + 1][krylov_max], cosine[krylov_max], sine[krylov_max], g[krylov_max + 1];
  for (long i = 0; i < count; ++i) x[i] = 0.0f;
  for (long i = 0; i < count; ++i) basis[i] = b[i];
  admit(contact, matrix.nodes, basis);
  const double size = __builtin_sqrt(product(basis, basis, count));
  if (!(size > 0.0)) return {0, 0.0};
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
  return {k, __builtin_fabs(g[k]) / size};
}

constexpr ClothKernel kernel_named(const char* name, bool supported) {
  return {name, supported, membrane, bending, bending_matrix, apply, factor, solve, krylov};
}

}  // namespace
}  // namespace sim_core
