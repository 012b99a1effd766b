// From one level to the next, and from three levels to the limit.
//
// The chain is a symmetric scheme: at a fixed node, frames and moments err by e2 h^2 + e4 h^4 + ...
// . Three levels h, 2h, 4h therefore give (64 y_h - 20 y_2h + y_4h) / 45 with an error O(h^6)
// [Richardson 1911]. Frames are extrapolated in the Lie algebra: as rotation vectors from the
// finest frame.
#pragma once

#include <vector>

#include "rods/newton.hpp"

namespace sim_core {
namespace {

// The section at node i of n, and at output point j.
template <class T>
const Rod<T>& node_section(const Rod<T>& rod, int, int) {
  return rod;
}

template <class T>
const Rod<T>& point_section(const Rod<T>& rod, int) {
  return rod;
}

// kappa = kappa_bar + K^{-1} m, the balance of moments.
template <class T>
Vec3<T> curvature(const Rod<T>& rod, Vec3<T> m) {
  return {rod.phi0 + m.x / rod.twist_stiffness, m.y, rod.phi1 + m.z};
}

// kappa' = kappa_bar' + K^{-1} m'
template <class T>
Vec3<T> curvature_rate(const Rod<T>& rod, Vec3<T> dm) {
  return {dm.x / rod.twist_stiffness, dm.y, dm.z};
}

// q' = q kappa / 2
template <class T>
Quat<T> spin(Quat<T> q, Vec3<T> kappa) {
  return T(0.5) * (q * Quat<T>{T(0.0), kappa});
}

// World vector in the material frame q.
template <class T>
Vec3<T> in_frame(Quat<T> q, Vec3<T> v) {
  return {dot(direction1(q), v), dot(direction2(q), v), dot(direction3(q), v)};
}

// Rotation vector from frame a to frame b, in the axes of a.
template <class T>
Vec3<T> rotation_between(Quat<T> a, Quat<T> b) {
  return logarithm(conjugate(a) * b).theta;
}

// Nodal moments and energy of the frames that were reached.
//
// The moment at a node is the discrete Legendre transform of the element after it, f - tau / 2 with
// tau the weight's torque on the node [Marsden and West 2001, Sec. 1.5]; being symmetric it keeps
// the even expansion in h.
template <int W, class AnyRod>
[[gnu::flatten]] void balance(const AnyRod& rod, Level<W>& level) {
  using T = Lanes<W>;
  const int n = level.elements;
  const double h = level.h();
  level.energy = T(0.0);
  for (int i = 0; i < n; ++i) {
    const auto e =
        element_moment(section(rod, i, n), level.frame[i], level.frame[i + 1], T(h), T(double(n)));
    const T weight = rod.gamma * T((1.0 - i * h) * h);
    const Vec3<T> t = direction1(level.frame[i]);
    const Vec3<T> world = jacobian_transposed(e.log, e.moment) - T(0.5) * weight_torque(weight, t);
    level.moment[i] = in_frame(level.frame[i], world);
    level.energy = level.energy + e.energy + (i == 0 ? T(0.5) : T(1.0)) * weight * t.z;
  }
  level.moment[n] = {T(0.0), T(0.0), T(0.0)};  // free end
}

// The natural shape, R(s) = R(0) exp(s kappa_bar): where the coarsest level starts.
template <int W>
void start_natural(const Rod<Lanes<W>>& rod, Level<W>& level) {
  using T = Lanes<W>;
  const T h(level.h());
  const Quat<T> turn = exponential(Vec3<T>{h * rod.phi0, T(0.0), h * rod.phi1});
  // Clamp: d1 = -e_z (along gravity), d2 = e_x, d3 = -e_y.
  level.frame[0] = {T(0.5), {T(0.5), T(0.5), T(-0.5)}};
  for (int i = 0; i < level.elements; ++i) level.frame[i + 1] = renormalized(level.frame[i] * turn);
}

// Start a level from the one of twice as many elements: every second frame.
template <int W>
void start_within(const Level<W>& fine, Level<W>& level) {
  for (int i = 0; i <= level.elements; ++i) level.frame[i] = fine.frame[2 * i];
}

// How one level differs from another at the same node: a rotation vector in the axes of the first,
// and moments.
template <class T>
struct Difference {
  Vec3<T> turn, moment;

  friend Difference operator+(Difference a, Difference b) {
    return {a.turn + b.turn, a.moment + b.moment};
  }
  friend Difference operator-(Difference a, Difference b) {
    return {a.turn - b.turn, a.moment - b.moment};
  }
  friend Difference operator*(T s, Difference a) { return {s * a.turn, s * a.moment}; }
};

// From node i of `from` to node j of `to`.
template <int W>
Difference<Lanes<W>> difference(const Level<W>& from, int i, const Level<W>& to, int j) {
  return {rotation_between(from.frame[i], to.frame[j]), to.moment[j] - from.moment[i]};
}

// A field known at every second node: the cubic through the four nearest known nodes gives the
// others.
template <class T>
void fill_odd_nodes(std::vector<Difference<T>>& field) {
  const int n = static_cast<int>(field.size()) - 1;
  const auto cubic = [&](int far, int near, int next, int last) {
    return T(0.0625) *
           (T(5.0) * field[far] + T(15.0) * field[near] - T(5.0) * field[next] + field[last]);
  };
  field[1] = cubic(0, 2, 4, 6);
  for (int i = 3; i < n - 1; i += 2) {
    field[i] = T(0.0625) * (T(9.0) * (field[i - 1] + field[i + 1]) - (field[i - 3] + field[i + 3]));
  }
  field[n - 1] = cubic(n, n - 2, n - 4, n - 6);
}

// Start a level from the one of half as many elements: cubic Hermite interpolation of the frames.
// Where a still coarser level is known, the error it shows is taken off first: y_h = y_2h - (y_4h -
// y_2h) / 4 + O(h^4).
template <int W, class AnyRod>
[[gnu::flatten]] void start_from(const AnyRod& rod, const Level<W>& coarse, const Level<W>* coarser,
                                 Level<W>& level, std::vector<Difference<Lanes<W>>>& error) {
  using T = Lanes<W>;
  const int n = coarse.elements;
  const T eighth(0.125 * coarse.h());
  error.assign(n + 1, Difference<T>{});
  if (coarser) {
    for (int k = 0; k <= coarser->elements; ++k)
      error[2 * k] = difference(coarse, 2 * k, *coarser, k);
    fill_odd_nodes(error);
  }
  level.frame[0] = coarse.frame[0];
  Quat<T> spin_before{};
  for (int i = 0; i <= n; ++i) {
    const Quat<T> q = renormalized(coarse.frame[i] * retraction(T(-0.25) * error[i].turn));
    const Quat<T> spin_here =
        spin(q, curvature(node_section(rod, i, n), coarse.moment[i] - T(0.25) * error[i].moment));
    level.frame[2 * i] = q;
    if (i > 0) {
      const Quat<T> before = level.frame[2 * i - 2];
      level.frame[2 * i - 1] =
          normalized(T(0.5) * (before + q) + eighth * (spin_before - spin_here));
    }
    spin_before = spin_here;
  }
}

// Frames and moments in the limit h -> 0, at the nodes of the middle level.
template <int W>
struct Limit {
  using T = Lanes<W>;

  std::vector<Quat<T>> frame;
  std::vector<Vec3<T>> moment;
  T energy{};
  T refinement{};  // largest turn of a frame by the last term of the extrapolation [rad]
};

// (64 y_h - 20 y_2h + y_4h) / 45 = y_h - (y_2h - y_h) / 3 + ((y_4h - y_h) - 5 (y_2h - y_h)) / 45.
// The last term, small and smooth, is known at the nodes of the coarsest level and interpolated to
// those of the middle one.
template <int W>
[[gnu::flatten]] void extrapolate(const Level<W>& coarse, const Level<W>& middle,
                                  const Level<W>& fine, Limit<W>& limit,
                                  std::vector<Difference<Lanes<W>>>& last) {
  using T = Lanes<W>;
  const int n = middle.elements;
  last.assign(n + 1, Difference<T>{});
  limit.frame.resize(n + 1);
  limit.moment.resize(n + 1);
  limit.refinement = T(0.0);
  for (int i = 0; i <= n; i += 2) {
    last[i] = T(1.0 / 45.0) * (difference(fine, 2 * i, coarse, i / 2) -
                               T(5.0) * difference(fine, 2 * i, middle, i));
    limit.refinement = max(limit.refinement, dot(last[i].turn, last[i].turn));
  }
  fill_odd_nodes(last);
  for (int i = 0; i <= n; ++i) {
    const Difference<T> change = last[i] - T(1.0 / 3.0) * difference(fine, 2 * i, middle, i);
    limit.frame[i] = renormalized(fine.frame[2 * i] * exponential(change.turn));
    limit.moment[i] = fine.moment[2 * i] + change.moment;
  }
  limit.refinement = sqrt(limit.refinement);
  limit.energy = T(1.0 / 45.0) * (T(64.0) * fine.energy - T(20.0) * middle.energy + coarse.energy);
}

}  // namespace
}  // namespace sim_core
