// Energy, gradient and matrix of bending.
#pragma once

#include "cloth/kernels/vectors.hpp"

namespace sim_core {
namespace {

// A fold by theta over the length h has s = h^2 |H|^2 = 4 sin^2(theta/2) where its energy should go
// as theta^2. The ratio r(s) = theta^2 / s turns the one into the other; beyond `fold_end` theta^2
// goes on as a parabola in s.
struct Stiffening {
  double ratio, slope, curvature;  // r, dr/ds, d2r/ds2
};

constexpr double fold_series = 0.4, fold_end = 3.8;

inline Stiffening stiffening_of(double s) {
  if (s < fold_series) {
    // theta^2 = 2 sum_n s^n / (n^2 C(2n, n))
    constexpr double c[11] = {1.0,           1.0 / 12,      1.0 / 90,      1.0 / 560,
                              1.0 / 3150,    1.0 / 16632,   1.0 / 84084,   1.0 / 411840,
                              1.0 / 1969110, 1.0 / 9237800, 1.0 / 42678636};
    double ratio = c[10], slope = 0.0, half_curvature = 0.0;
    for (int n = 9; n >= 0; --n) {
      half_curvature = half_curvature * s + slope;
      slope = slope * s + ratio;
      ratio = ratio * s + c[n];
    }
    return {ratio, slope, 2.0 * half_curvature};
  }
  const double at = s < fold_end ? s : fold_end;
  const double theta = 2.0 * __builtin_asin(0.5 * __builtin_sqrt(at));
  const double sine = __builtin_sin(theta), cosine = __builtin_cos(theta);
  // v = theta^2 and its derivatives by s; r = v/s, r' = (v' - r)/s, r'' = (v'' - 2 r')/s.
  const double second = (sine - theta * cosine) / (2.0 * sine * sine * sine);
  double value = theta * theta, first = theta / sine;
  if (s > fold_end) {
    const double beyond = s - fold_end;
    value += beyond * (first + 0.5 * beyond * second);
    first += beyond * second;
  }
  const double slope = (first - value / s) / s;
  return {value / s, slope, (second - 2.0 * slope) / s};
}

// Rigidity that falls with curvature: M = (D - |b| k) k, as measured of cloth [Feng et al. 2022],
// but not below `softest` D k, where M would begin to fall. With k_s = D/|b| the energy per area is
// D k^2/2 psi, and in terms of e = D k^2 it is G(e)/2:
//
//     G' = 1 - k/k_s,   G'' = -1/(2 D k_s k)    up to k = (1 - softest) k_s
//     G' = softest,     G'' = 0                 beyond
//
// For a plate k is that of the energy, e = H:D:H with the mean rigidity D of warp and weft: the
// energy is then convex in H, as long as G' is at least 1/2.
struct Softened {
  double value, slope, curvature;  // G, dG/de, d2G/de2
};

constexpr double softest = 0.5;

// Curvature over k_s below which nothing has softened, and above which it counts in the matrix.
constexpr double soft_from = 1e-9, soft_counts = 0.02;

inline Softened softened_of(const SofteningData& fabric, double e) {
  const double share = __builtin_sqrt(e / fabric.rigidity) / fabric.curvature;  // k/k_s
  const double end = 1.0 - softest;
  if (share < soft_from) return {e, 1.0, 0.0};
  if (share < end) {
    return {e * (1.0 - 2.0 / 3.0 * share), 1.0 - share, -0.5 * share / e};
  }
  const double unit = fabric.rigidity * fabric.curvature * fabric.curvature;
  const double value_at_end = unit * end * end * (1.0 - 2.0 / 3.0 * end);
  return {value_at_end + softest * (e - unit * end * end), softest, 0.0};
}

inline int store_fold(FoldData* folds, int entry, int node, NodeD a, NodeD b) {
  folds->nodes[entry] = node;
  float* to = folds->vectors + 8L * entry;
  for (int c = 0; c < 4; ++c) {
    to[c] = float(a[c]);
    to[4 + c] = float(b[c]);
  }
  return entry + 1;
}

// W = A/2 r(s) q for each triangle, q = H:D:H and s = h^2 H:N:H with N = diag(1, 1, 1/2). By H its
// derivatives are, with m = D H and n = N H,
//
//     W'  = A (r m + q r' h^2 n)
//     W'' = A (r D + q r' h^2 N) + A (2 q r'' h^4 n n^T + 2 r' h^2 (n m^T + m n^T))
//
// The first part of W'' acts on x, y and z alike and goes into the matrix (`stiffening`), the
// second into `folds`. Where rigidity falls with curvature, W = A/2 G(r q): derivatives are those
// above times G', and W'' has 2 A G'' (r m + q r' h^2 n) (r m + q r' h^2 n)^T besides.
double bending(const BendingData& data, const double* x, double* gradient, float* stiffening,
               FoldData* folds) {
  int entries = 0;
  if (folds) folds->count = 0;
  double energy = 0.0;
  for (int t = 0; t < data.triangles; ++t) {
    const double* d = data.rigidity + 6L * data.fabric[t];
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
    Stiffening fold = stiffening_of(s);
    const SofteningData& fabric = data.softening[data.fabric[t]];
    const double area = data.area[t];
    // What softening adds to W'': across (r m + q r' h^2 n), which is `ratio` b + `along` a.
    double across = 0.0, ratio = 0.0, along = 0.0;
    if (fabric.curvature > 0.0) {
      const Softened soft = softened_of(fabric, fold.ratio * q);
      ratio = fold.ratio;
      along = q * fold.slope * data.spacing2[t];
      across = 2.0 * area * soft.curvature;
      energy += 0.5 * area * (soft.value - soft.slope * ratio * q);
      fold = {soft.slope * fold.ratio, soft.slope * fold.slope, soft.slope * fold.curvature};
    }
    const double turn = q * fold.slope * data.spacing2[t];
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
    // This is A k/k_s.
    const bool softens = -across * ratio * q > soft_counts * area;
    if (folds && (s > folds->smallest || softens)) {
      const double size2 = data.spacing2[t];
      float* coefficients = folds->coefficients + 3L * folds->count;
      coefficients[0] = float(2.0 * area * q * fold.curvature * size2 * size2);
      coefficients[1] = float(2.0 * area * fold.slope * size2);
      coefficients[2] = 0.0f;
      if (across != 0.0) {
        coefficients[0] += float(across * along * along);
        coefficients[1] += float(across * ratio * along);
        coefficients[2] = float(across * ratio * ratio);
      }
      folds->begin[folds->count++] = entries;
      for (int i = begin; i < end; ++i) {
        if (data.nodes[i] >= folds->free_nodes) continue;
        const double* w = data.weights + 4L * i;
        const NodeD a = spread(w[0]) * h0 + spread(w[1]) * h1 + spread(0.5 * w[2]) * h2;
        entries = store_fold(folds, entries, data.nodes[i], a,
                             spread(w[0]) * m0 + spread(w[1]) * m1 + spread(w[2]) * m2);
      }
      folds->begin[folds->count] = entries;
    }
  }
  return energy;
}

// Adds how the gradient changes along each of `count` vectors, at most `solve_group`. With
// r = A G' r(s) and u = A G' q r' h^2 the gradient is r m + u n, and its change
//
//     r dm + u dn + dr m + du n,   dq = 2 m:dH,   ds = 2 h^2 n:dH.
void bending_changes(const BendingData& data, const double* x, int count,
                     const double* const* along, double* const* changes) {
  for (int t = 0; t < data.triangles; ++t) {
    const double* d = data.rigidity + 6L * data.fabric[t];
    const int begin = data.begin[t], end = data.begin[t + 1];
    const auto curvatures = [&](const double* at, NodeD(&h)[3]) {
      for (int i = begin; i < end; ++i) {
        const NodeD p = *reinterpret_cast<const NodeD*>(at + 4L * data.nodes[i]);
        for (int k = 0; k < 3; ++k) h[k] += spread(data.weights[4L * i + k]) * p;
      }
    };
    const auto moments = [&](const NodeD(&h)[3], NodeD(&m)[3]) {
      m[0] = spread(d[0]) * h[0] + spread(d[1]) * h[1] + spread(d[2]) * h[2];
      m[1] = spread(d[1]) * h[0] + spread(d[3]) * h[1] + spread(d[4]) * h[2];
      m[2] = spread(d[2]) * h[0] + spread(d[4]) * h[1] + spread(d[5]) * h[2];
    };
    NodeD h[3] = {}, m[3];
    curvatures(x, h);
    moments(h, m);
    const double q = dot3(m[0], h[0]) + dot3(m[1], h[1]) + dot3(m[2], h[2]);
    const double size2 = data.spacing2[t], area = data.area[t];
    const double s = size2 * (dot3(h[0], h[0]) + dot3(h[1], h[1]) + 0.5 * dot3(h[2], h[2]));
    const Stiffening fold = stiffening_of(s);
    const SofteningData& fabric = data.softening[data.fabric[t]];
    double soft = 1.0, softer = 0.0;  // G' and G''
    if (fabric.curvature > 0.0) {
      const Softened softened = softened_of(fabric, fold.ratio * q);
      soft = softened.slope;
      softer = softened.curvature;
    }
    const double r = area * soft * fold.ratio, u = area * soft * q * fold.slope * size2;
    for (int p = 0; p < count; ++p) {
      NodeD dh[3] = {}, dm[3];
      curvatures(along[p], dh);
      moments(dh, dm);
      const double dq = 2.0 * (dot3(m[0], dh[0]) + dot3(m[1], dh[1]) + dot3(m[2], dh[2]));
      const double ds =
          2.0 * size2 * (dot3(h[0], dh[0]) + dot3(h[1], dh[1]) + 0.5 * dot3(h[2], dh[2]));
      const double d_soft = softer * (fold.slope * ds * q + fold.ratio * dq);
      const double dr = area * (soft * fold.slope * ds + d_soft * fold.ratio);
      const double du =
          area * size2 *
          (soft * (dq * fold.slope + q * fold.curvature * ds) + d_soft * q * fold.slope);
      NodeD force[3];
      for (int k = 0; k < 3; ++k) {
        const double share = k < 2 ? 1.0 : 0.5;  // of N
        force[k] = spread(r) * dm[k] + spread(dr) * m[k] + spread(share * u) * dh[k] +
                   spread(share * du) * h[k];
      }
      for (int i = begin; i < end; ++i) {
        const double* w = data.weights + 4L * i;
        *reinterpret_cast<NodeD*>(changes[p] + 4L * data.nodes[i]) +=
            spread(w[0]) * force[0] + spread(w[1]) * force[1] + spread(w[2]) * force[2];
      }
    }
  }
}

void bending_matrix(const BendingData& data, const float* stiffening, float* scalars) {
  for (int t = 0; t < data.triangles; ++t) {
    const double* d = data.rigidity + 6L * data.fabric[t];
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
