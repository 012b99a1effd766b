// Energy, gradient and matrix of bending.
#pragma once

#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

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

}  // namespace
}  // namespace sim_core
