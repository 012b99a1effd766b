// Energy, gradient and matrix of stretching.
#pragma once

#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

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

}  // namespace
}  // namespace sim_core
