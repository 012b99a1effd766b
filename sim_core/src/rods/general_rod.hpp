// A rod whose natural curvature varies along it, with three stiffnesses and any clamp: the
// functions of a rod and its sections that energy.hpp and levels.hpp ask for.
//
//   E = \int_0^1 1/2 (kappa - kappa_bar(s))^T K (kappa - kappa_bar(s)) + gamma (1 - s) t . e_z ds,
//   K = diag(K0, K1, K2)
//
// An element takes kappa_bar at its middle, which keeps the scheme symmetric and its error even in
// h.
#pragma once

#include "rods/levels.hpp"

namespace sim_core {
namespace {

template <class T>
struct GeneralRod {
  T gamma;            // weight rho A g L^3 / EI
  Vec3<T> stiffness;  // twist, bend about d2, bend about d3; EI
  Quat<T> clamp;      // frame at s = 0
  int intervals;  // of the grid of `natural` and `start`: twice the elements of the finest level
  const Vec3<T>* natural;  // (intervals + 1): kappa_bar at uniform arc length, 1/L
  const Vec3<T>* start;    // (intervals + 1): curvature of the shape that the search starts from
  const Vec3<T>* slope;   // (intervals / 4 + 1): kappa_bar' at the nodes of the middle level, 1/L^2
  const Vec3<T>* points;  // kappa_bar at the output points
};

// One place of such a rod. The slope is known at nodes of the middle level only.
template <class T>
struct GeneralSection {
  Vec3<T> natural, stiffness, slope;
};

template <class T>
GeneralSection<T> section(const GeneralRod<T>& rod, int i, int elements) {
  return {rod.natural[(2 * i + 1) * (rod.intervals / (2 * elements))], rod.stiffness, {}};
}

template <class T>
GeneralSection<T> node_section(const GeneralRod<T>& rod, int i, int elements) {
  const Vec3<T> none{T(0.0), T(0.0), T(0.0)};
  const bool middle = 4 * elements == rod.intervals;
  return {rod.natural[i * (rod.intervals / elements)], rod.stiffness, middle ? rod.slope[i] : none};
}

template <class T>
GeneralSection<T> point_section(const GeneralRod<T>& rod, int j) {
  return {rod.points[j], rod.stiffness, {}};
}

template <class T>
T energy_scale(const GeneralRod<T>& rod) {
  T largest(0.0);
  for (int i = 0; i <= rod.intervals; ++i) {
    const Vec3<T> k = rod.natural[i];
    largest = max(largest, rod.stiffness.x * k.x * k.x + rod.stiffness.y * k.y * k.y +
                               rod.stiffness.z * k.z * k.z);
  }
  return T(1.0) + rod.gamma + largest;
}

template <class T>
ElementMoment<T> element_moment(const GeneralSection<T>& here, Quat<T> a, Quat<T> b, T h,
                                T inverse_h) {
  const Quat<T> turn = b * conjugate(a);
  const Logarithm<T> log = logarithm(turn);
  const Vec3<T> d1 = direction1(b), d2 = direction2(b), d3 = direction3(b),
                theta = inverse_h * log.theta;
  const Vec3<T> strain = Vec3<T>{dot(d1, theta), dot(d2, theta), dot(d3, theta)} - here.natural;
  const Vec3<T> m{here.stiffness.x * strain.x, here.stiffness.y * strain.y,
                  here.stiffness.z * strain.z};
  return {log, d1, m.x * d1 + m.y * d2 + m.z * d3, T(0.5) * h * dot(strain, m), turn.w, d2};
}

// As for a uniform rod, with R K R^T = K2 I + (K0 - K2) d1 d1^T + (K1 - K2) d2 d2^T.
template <class T>
Sym3<T> element_stiffness(const GeneralSection<T>& here, const ElementMoment<T>& e, T inverse_h) {
  const Vec3<T> u1 = jacobian_transposed(e.log, e.tangent),
                u2 = jacobian_transposed(e.log, e.second);
  const Vec3<T> K = here.stiffness;
  return isotropic_stiffness(e, inverse_h * K.z) +
         scaled_identity_plus_symmetric_product(T(0.0), inverse_h * (K.x - K.z) * u1, u1) +
         scaled_identity_plus_symmetric_product(T(0.0), inverse_h * (K.y - K.z) * u2, u2);
}

template <class T>
Vec3<T> curvature(const GeneralSection<T>& here, Vec3<T> m) {
  const Vec3<T> K = here.stiffness;
  return here.natural + Vec3<T>{m.x / K.x, m.y / K.y, m.z / K.z};
}

template <class T>
Vec3<T> curvature_rate(const GeneralSection<T>& here, Vec3<T> dm) {
  const Vec3<T> K = here.stiffness;
  return here.slope + Vec3<T>{dm.x / K.x, dm.y / K.y, dm.z / K.z};
}

// The shape of curvature `start`, R' = R [start]x by the middle of each element.
template <int W>
void start_natural(const GeneralRod<Lanes<W>>& rod, Level<W>& level) {
  const int n = level.elements;
  level.frame[0] = rod.clamp;
  for (int i = 0; i < n; ++i) {
    const Vec3<Lanes<W>> middle = rod.start[(2 * i + 1) * (rod.intervals / (2 * n))];
    level.frame[i + 1] = renormalized(level.frame[i] * exponential(Lanes<W>(level.h()) * middle));
  }
}

}  // namespace
}  // namespace sim_core
