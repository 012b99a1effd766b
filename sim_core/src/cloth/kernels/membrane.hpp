// Energy, gradient and matrix of stretching.
#pragma once

#include "cloth/kernels/stretching.hpp"
#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

// Adds a block of each lane, or its transpose, at slot `place` of the nine of its triangle.
inline void add_blocks(float* blocks, const int* slots, int place, const Lane (&block)[3][3],
                       bool transposed) {
  float entry[3][3][membrane_lanes];
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) {
      for (int l = 0; l < membrane_lanes; ++l)
        entry[transposed ? r : c][transposed ? c : r][l] = float(block[r][c][l]);
    }
  }
  for (int l = 0; l < membrane_lanes; ++l) {
    const int slot = slots[9 * l + place];
    if (slot < 0) continue;
    Node* columns = reinterpret_cast<Node*>(blocks + 12L * slot);
    for (int c = 0; c < 3; ++c)
      columns[c] += Node{entry[c][0][l], entry[c][1][l], entry[c][2][l], 0.0f};
  }
}

// The deformation gradient and Green's strain of a group of triangles.
struct Strained {
  Lane n[3][2];  // gradients of the shape functions, 1/m
  Lane f[2][3];
  Lane a, h, q;
};

inline Strained strained(const MembraneData& data, int group, const double* x) {
  constexpr int W = membrane_lanes;
  const int* nodes = data.nodes + 3L * W * group;
  Lane p[3][3];
  for (int a = 0; a < 3; ++a) {
    for (int l = 0; l < W; ++l) {
      const double* at = x + 4L * nodes[W * a + l];
      for (int c = 0; c < 3; ++c) p[a][c][l] = at[c];
    }
  }
  const Lane* shape = reinterpret_cast<const Lane*>(data.shape + 4L * W * group);
  Strained out{
      {{-shape[0] - shape[2], -shape[1] - shape[3]}, {shape[0], shape[1]}, {shape[2], shape[3]}},
      {},
      {},
      {},
      {}};
  Lane(&f)[2][3] = out.f;
  for (int c = 0; c < 3; ++c) {
    const Lane u = p[1][c] - p[0][c], v = p[2][c] - p[0][c];
    f[0][c] = u * shape[0] + v * shape[2];
    f[1][c] = u * shape[1] + v * shape[3];
  }
  const Lane g00 = 0.5 * (f[0][0] * f[0][0] + f[0][1] * f[0][1] + f[0][2] * f[0][2] - 1.0);
  const Lane g11 = 0.5 * (f[1][0] * f[1][0] + f[1][1] * f[1][1] + f[1][2] * f[1][2] - 1.0);
  out.a = 0.5 * (g00 + g11);
  out.h = 0.5 * (g00 - g11);
  out.q = 0.5 * (f[0][0] * f[1][0] + f[0][1] * f[1][1] + f[0][2] * f[1][2]);
  return out;
}

// Where the law is not convex where a step starts, a share of what makes it convex holds strain
// there: a viscosity that falls as the step and vanishes at rest, so that a step has one end.
// Convex splitting [Eyre 1998].
inline void add_lag(StretchLaw& law, const Lane* lag, const Strained& now) {
  const Lane a = now.a - lag[0], h = now.h - lag[1], q = now.q - lag[2];
  law.a += lag[3] * a + lag[4] * h + lag[5] * q;
  law.h += lag[4] * a + lag[6] * h + lag[7] * q;
  law.q += lag[5] * a + lag[7] * h + lag[8] * q;
  law.aa += lag[3], law.ah += lag[4], law.aq += lag[5], law.hh += lag[6], law.hq += lag[7],
      law.qq += lag[8];
}

void membrane_lag(const MembraneData& data, const double* x, double fraction, double* lag) {
  for (int group = 0; group < data.groups; ++group) {
    const int fabric = data.fabric[group];
    const Strained now = strained(data, group, x);
    const StretchLaw law =
        stretch_law<true>(data.law + 24L * fabric, data.tabulated[fabric], now.a, now.h, now.q);
    StretchLaw positive = law;
    make_definite(positive);
    const Lane entries[9] = {now.a,
                             now.h,
                             now.q,
                             fraction * (positive.aa - law.aa),
                             fraction * (positive.ah - law.ah),
                             fraction * (positive.aq - law.aq),
                             fraction * (positive.hh - law.hh),
                             fraction * (positive.hq - law.hq),
                             fraction * (positive.qq - law.qq)};
    for (int i = 0; i < 9; ++i)
      *reinterpret_cast<Lane*>(lag + (9L * group + i) * membrane_lanes) = entries[i];
  }
}

// s00, s11, s01 of a symmetric 2 x 2 matrix.
struct Stress {
  Lane s00, s11, s01;
};

// The part of a stress with eigenvalues above zero, times the area.
inline Stress positive_part(const Stress& stress, const Lane area) {
  const Lane zero{};
  const Lane mean = 0.5 * (stress.s00 + stress.s11), half = 0.5 * (stress.s00 - stress.s11);
  const Lane radius = root(half * half + stress.s01 * stress.s01) + 1e-30;
  const Lane big = mean + radius, small = mean - radius;
  const Lane big_plus = big > zero ? big : zero, small_plus = small > zero ? small : zero;
  const Lane middle = 0.5 * (big_plus + small_plus),
             spread_ratio = 0.5 * (big_plus - small_plus) / radius;
  return {area * (middle + spread_ratio * half), area * (middle - spread_ratio * half),
          area * spread_ratio * stress.s01};
}

inline void add_membrane_force(const int* nodes, const Strained& now, const Stress& stress,
                               const Lane area, double* gradient) {
  constexpr int W = membrane_lanes;
  const Lane(&n)[3][2] = now.n;
  const Lane(&f)[2][3] = now.f;
  Lane force[3][3];
  for (int a = 0; a < 3; ++a) {
    const Lane u = area * (stress.s00 * n[a][0] + stress.s01 * n[a][1]),
               v = area * (stress.s01 * n[a][0] + stress.s11 * n[a][1]);
    for (int c = 0; c < 3; ++c) force[a][c] = f[0][c] * u + f[1][c] * v;
  }
  for (int a = 0; a < 3; ++a) {
    for (int l = 0; l < W; ++l) {
      double* at = gradient + 4L * nodes[W * a + l];
      for (int c = 0; c < 3; ++c) at[c] += force[a][c][l];
    }
  }
}

// Second derivatives, with the law by Green's strain and the stress times the area.
inline void add_membrane_matrix(const int* slots, const Strained& now, const StretchLaw& law,
                                const Stress& stress, const Lane area, float* blocks) {
  const Lane zero{};
  const Lane(&n)[3][2] = now.n;
  const Lane(&f)[2][3] = now.f;
  // Of (s00, s11, s01) by (G00, G11, 2 G01).
  const Lane quarter = 0.25 * area;
  const Lane c00 = quarter * (law.aa + 2.0 * law.ah + law.hh),
             c11 = quarter * (law.aa - 2.0 * law.ah + law.hh);
  const Lane c01 = quarter * (law.aa - law.hh), c22 = quarter * law.qq;
  const Lane c02 = quarter * (law.aq + law.hq), c12 = quarter * (law.aq - law.hq);
  constexpr int first[3] = {0, 0, 1}, second[3] = {1, 2, 2};
  Lane diagonal[3][3][3] = {};  // a translation costs nothing: rows add up to zero
  for (int pair = 0; pair < 3; ++pair) {
    const Lane *a = n[first[pair]], *b = n[second[pair]];
    const Lane ab00 = a[0] * b[0], ab01 = a[0] * b[1], ab10 = a[1] * b[0], ab11 = a[1] * b[1],
               mixed = ab01 + ab10;
    const Lane m00 = c00 * ab00 + c02 * mixed + c22 * ab11,
               m11 = c11 * ab11 + c12 * mixed + c22 * ab00;
    const Lane both = c02 * ab00 + c12 * ab11;
    const Lane m01 = c01 * ab01 + c22 * ab10 + both, m10 = c01 * ab10 + c22 * ab01 + both;
    const Lane geometric = stress.s00 * ab00 + stress.s01 * mixed + stress.s11 * ab11;
    Lane block[3][3];
    for (int r = 0; r < 3; ++r) {
      const Lane u = m00 * f[0][r] + m10 * f[1][r], v = m01 * f[0][r] + m11 * f[1][r];
      for (int c = 0; c < 3; ++c) {
        block[r][c] = u * f[0][c] + v * f[1][c] + (r == c ? geometric : zero);
        diagonal[first[pair]][r][c] -= block[r][c];
        diagonal[second[pair]][c][r] -= block[r][c];
      }
    }
    add_blocks(blocks, slots, 2 * pair, block, false);
    add_blocks(blocks, slots, 2 * pair + 1, block, true);
  }
  for (int a = 0; a < 3; ++a) add_blocks(blocks, slots, 6 + a, diagonal[a], false);
}

// Green's strain G = (F^T F - 1)/2 and the law of kernels/stretching.hpp. The matrix is the second
// derivative; a `definite` one has only the positive part of the stress and of the law [Teran et
// al. 2005].
template <bool matrix>
double membrane_groups(const MembraneData& data, const double* x, double* gradient, float* blocks,
                       bool definite) {
  constexpr int W = membrane_lanes;
  Lane energy{};
  for (int group = 0; group < data.groups; ++group) {
    const int fabric = data.fabric[group];
    const Lane area = *reinterpret_cast<const Lane*>(data.area + 1L * W * group);
    const Strained now = strained(data, group, x);
    StretchLaw law =
        stretch_law<matrix>(data.law + 24L * fabric, data.tabulated[fabric], now.a, now.h, now.q);
    if (data.lag) add_lag(law, reinterpret_cast<const Lane*>(data.lag + 9L * W * group), now);
    const Stress stress{0.5 * (law.a + law.h), 0.5 * (law.a - law.h), 0.5 * law.q};
    energy += area * law.energy;
    add_membrane_force(data.nodes + 3L * W * group, now, stress, area, gradient);
    if constexpr (matrix) {
      Stress in_matrix{area * stress.s00, area * stress.s11, area * stress.s01};
      if (definite) {
        in_matrix = positive_part(stress, area);
        make_definite(law);
      }
      add_membrane_matrix(data.slots + 9L * W * group, now, law, in_matrix, area, blocks);
    }
  }
  double total = 0.0;
  for (int l = 0; l < W; ++l) total += energy[l];
  return total;
}

double membrane(const MembraneData& data, const double* x, double* gradient, float* blocks,
                bool definite) {
  return blocks ? membrane_groups<true>(data, x, gradient, blocks, definite)
                : membrane_groups<false>(data, x, gradient, nullptr, definite);
}

}  // namespace
}  // namespace sim_core
