// From nodal frames and moments to the output points.
//
// The Kirchhoff equations give the derivatives of everything at the nodes [Bertails-Descoubes et al. 2018, Eq. 1-4]:
//   kappa = kappa_bar + K^{-1} m,   m' = m x kappa - gamma (1 - s) e_x x g,   g' = g x kappa,   r' = t,
// with g the direction of gravity in the material frame; quintic Hermite interpolation does the rest.
#pragma once

#include <vector>

#include "rods/levels.hpp"
#include "rods/rods.hpp"

namespace sim_core {
namespace {

// A field with its first and second derivatives in s.
template <class Field>
struct Jet {
  Field y, d1, d2;
};

template <class T>
struct NodeJets {
  Jet<Vec3<T>> moment, centerline;
  Jet<Quat<T>> frame;
  Vec3<T> bend;  // t'' in the world; centerline holds r, r' = t, r'' = t'
};

// Everything but the position, which is a sum over the nodes before.
template <class T, class Section>
NodeJets<T> node_jet(const Section& section, T gamma, double s, Quat<T> q, Vec3<T> m) {
  const Vec3<T> d1 = direction1(q), d2 = direction2(q), d3 = direction3(q);
  const Vec3<T> g{-d1.z, -d2.z, -d3.z};
  const Vec3<T> kappa = curvature(section, m);
  const T load = gamma * T(1.0 - s);
  const auto turned_by_tangent = [](Vec3<T> v) { return Vec3<T>{T(0.0), -v.z, v.y}; };  // e_x x v
  const Vec3<T> dm = cross(m, kappa) - load * turned_by_tangent(g);
  const Vec3<T> dkappa = curvature_rate(section, dm);
  const Vec3<T> dg = cross(g, kappa);
  const Vec3<T> ddm = cross(dm, kappa) + cross(m, dkappa) + gamma * turned_by_tangent(g) - load * turned_by_tangent(dg);
  const Quat<T> dq = spin(q, kappa);
  const Quat<T> ddq = spin(dq, kappa) + spin(q, dkappa);
  // t' = R (kappa x e_x), t'' = R (kappa x (kappa x e_x) + kappa' x e_x)
  const Vec3<T> dt = kappa.z * d2 - kappa.y * d3;
  const Vec3<T> ddt = T(-1.0) * (kappa.y * kappa.y + kappa.z * kappa.z) * d1 + (kappa.x * kappa.y + dkappa.z) * d2 +
                      (kappa.x * kappa.z - dkappa.y) * d3;
  return {{m, dm, ddm}, {Vec3<T>{}, d1, dt}, {q, dq, ddq}, ddt};
}

template <class T, class Field>
Field hermite(const SamplePoint& p, const Jet<Field>& a, const Jet<Field>& b) {
  return (T(p.weight[0]) * a.y + T(p.weight[1]) * a.d1 + T(p.weight[2]) * a.d2) +
         (T(p.weight[3]) * b.y + T(p.weight[4]) * b.d1 + T(p.weight[5]) * b.d2);
}

template <int W, class AnyRod>
[[gnu::flatten]] void node_jets(const AnyRod& rod, const Limit<W>& limit, std::vector<NodeJets<Lanes<W>>>& nodes) {
  using T = Lanes<W>;
  const int n = static_cast<int>(limit.frame.size()) - 1;
  const double h = 1.0 / n;
  nodes.resize(n + 1);
  for (int i = 0; i <= n; ++i)
    nodes[i] = node_jet(node_section(rod, i, n), rod.gamma, i * h, limit.frame[i], limit.moment[i]);
  // Quintic Hermite quadrature of the tangent, error O(h^7) per interval.
  for (int i = 0; i < n; ++i) {
    const NodeJets<T>&a = nodes[i], &b = nodes[i + 1];
    nodes[i + 1].centerline.y = a.centerline.y + T(h / 2.0) * (a.centerline.d1 + b.centerline.d1) +
                                T(h * h / 10.0) * (a.centerline.d2 - b.centerline.d2) +
                                T(h * h * h / 120.0) * (a.bend + b.bend);
  }
}

// Write lane l of a vector to out[l * stride ...], for those of the first `count` lanes that the mask names.
template <int W>
void scatter(Vec3<Lanes<W>> v, double* out, std::int64_t stride, int step, Mask<W> mask, int count) {
  for (int lane = 0; lane < count; ++lane) {
    if (mask.v[lane] == 0) continue;
    double* to = out + lane * stride;
    to[0] = v.x.v[lane];
    to[step] = v.y.v[lane];
    to[2 * step] = v.z.v[lane];
  }
}

// Sample the masked ones of the first `count` lanes into rods begin ... begin + count of the batch.
template <int W, class AnyRod>
[[gnu::flatten]] void sample(const AnyRod& rod, const std::vector<NodeJets<Lanes<W>>>& nodes,
                             const std::vector<SamplePoint>& points, const RodOutput& output, Mask<W> mask,
                             std::int64_t begin, int count) {
  using T = Lanes<W>;
  const std::int64_t stride = 3 * static_cast<std::int64_t>(points.size());
  for (std::size_t j = 0; j < points.size(); ++j) {
    const SamplePoint& p = points[j];
    const NodeJets<T>&a = nodes[p.node], &b = nodes[p.node + 1];
    const Quat<T> q = normalized(hermite<T>(p, a.frame, b.frame));
    const Vec3<T> kappa = curvature(point_section(rod, static_cast<int>(j)), hermite<T>(p, a.moment, b.moment));
    const std::int64_t at = begin * stride + 3 * static_cast<std::int64_t>(j);
    scatter(hermite<T>(p, a.centerline, b.centerline), output.centerline + at, stride, 1, mask, count);
    scatter(kappa, output.curvature + at, stride, 1, mask, count);
    double* frame = output.frame + 3 * at;
    scatter(direction1(q), frame, 3 * stride, 3, mask, count);
    scatter(direction2(q), frame + 1, 3 * stride, 3, mask, count);
    scatter(direction3(q), frame + 2, 3 * stride, 3, mask, count);
  }
}

}  // namespace
}  // namespace sim_core
