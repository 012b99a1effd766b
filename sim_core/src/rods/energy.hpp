// The energy of a hanging Kirchhoff rod on a geodesic chain of frames, with its gradient and
// Hessian.
//
//   E = \int_0^1 1/2 (kappa - kappa_bar)^T K (kappa - kappa_bar) + gamma (1 - s) t . e_z ds [EI/L]
//
// with K = diag(C, 1, 1), C = GJ/EI, kappa_bar = (phi0, 0, phi1), t the tangent, e_z up [Bertails
// et al. 2006, Sec. 3]. Element e turns frame R_a into R_b with constant strain: kappa = log(R_a^T
// R_b) / h. The weight is lumped at nodes.
//
// Unknowns are rotations of the nodes in world axes, R <- exp(omega) R. As both bending stiffnesses
// are equal, R K R^T = I + (C - 1) t t^T, and an element needs world vectors only, no matrix
// product.
#pragma once

#include "math/lanes.hpp"

namespace sim_core {
namespace {

// A pack of rods, one per lane. Everything is non-dimensional.
template <class T>
struct Rod {
  T gamma;            // weight rho A g L^3 / EI
  T phi0, phi1;       // natural twist and natural bend, times L
  T twist_stiffness;  // C = GJ/EI
};

// What element i of n is made of: a uniform rod is its own section everywhere. general_rod.hpp
// overloads this and the other functions of a rod and its sections.
template <class T>
const Rod<T>& section(const Rod<T>& rod, int, int) {
  return rod;
}

// The size of the rod's energies, for rounding noise.
template <class T>
T energy_scale(const Rod<T>& rod) {
  return T(1.0) + rod.gamma + rod.phi0 * rod.phi0 + rod.phi1 * rod.phi1;
}

template <class T>
struct Element {
  T energy;
  Vec3<T> force;  // f = dE/d omega_b = -dE/d omega_a: the moment carried by the element, world axes
  Sym3<T> stiffness;  // S: d2E = [S, -S + [f]x/2; ., S] over (omega_a, omega_b)
};

template <class T>
struct ElementMoment {
  Logarithm<T> log;  // of R_b R_a^T: the rotation over the element, world axes
  Vec3<T> tangent;   // of frame b
  Vec3<T> moment;    // R_b K (kappa - kappa_bar)
  T energy;
  T cosine;          // of half the rotation over the element; the logarithm holds for cosine >= 0
  Vec3<T> second{};  // d2 of frame b, where the two bending stiffnesses differ
};

template <class T>
ElementMoment<T> element_moment(const Rod<T>& rod, Quat<T> a, Quat<T> b, T h, T inverse_h) {
  const Quat<T> turn = b * conjugate(a);
  const Logarithm<T> log = logarithm(turn);
  const Vec3<T> t = direction1(b);
  const Vec3<T> strain = inverse_h * log.theta - rod.phi0 * t - rod.phi1 * direction3(b);
  const Vec3<T> moment = strain + ((rod.twist_stiffness - T(1.0)) * dot(strain, t)) * t;
  return {log, t, moment, T(0.5) * h * dot(strain, moment), turn.w};
}

// J^T v with J = I + [theta]x/2 + c [theta]x^2, the inverse right Jacobian of exp: d theta = J
// (omega_b - omega_a).
template <class T>
Vec3<T> jacobian_transposed(const Logarithm<T>& log, Vec3<T> v) {
  return v + T(0.5) * cross(v, log.theta) + log.c * (dot(log.theta, v) * log.theta - log.x * v);
}

// S = J^T k J + sym(d(J^T m)/d theta J) for a stiffness k = K/h that is a number, expanded with
// [theta]x^3 = -x [theta]x.
template <class T>
Sym3<T> isotropic_stiffness(const ElementMoment<T>& e, T k) {
  const Vec3<T> theta = e.log.theta;
  const T x = e.log.x, c = e.log.c, tm = dot(theta, e.moment);
  // J^T J = (1 - a x) I + a theta theta^T
  const T a = T(2.0) * c - T(0.25) - c * c * x;
  const Vec3<T> v = (T(0.25) - c) * e.moment + c * cross(e.moment, theta) +
                    (c * c + T(2.0) * e.log.dc) * (tm * theta - x * e.moment);
  const T identity = k * (T(1.0) - a * x) + tm * (c - T(0.25) - c * c * x);
  return scaled_identity_plus_symmetric_product(identity, theta, v + (k * a + c * c * tm) * theta);
}

template <class T>
Sym3<T> element_stiffness(const Rod<T>& rod, const ElementMoment<T>& e, T inverse_h) {
  const Vec3<T> u = jacobian_transposed(e.log, e.tangent);
  return isotropic_stiffness(e, inverse_h) +
         scaled_identity_plus_symmetric_product(T(0.0),
                                                inverse_h * (rod.twist_stiffness - T(1.0)) * u, u);
}

template <class T, class Section>
Element<T> element(const Section& section, const ElementMoment<T>& e, T inverse_h) {
  return {e.energy, jacobian_transposed(e.log, e.moment), element_stiffness(section, e, inverse_h)};
}

// Torque of the weight lumped at a node, dE/d omega = w t x e_z, with w = gamma (1 - s) h.
template <class T>
Vec3<T> weight_torque(T w, Vec3<T> t) {
  return {w * t.y, -(w * t.x), T(0.0)};
}

// Hessian of w t . e_z: w (sym(e_z t^T) - (t . e_z) I).
template <class T>
Sym3<T> weight_stiffness(T w, Vec3<T> t) {
  const T lift = -(w * t.z), half = T(0.5) * w;
  return {lift, T(0.0), half * t.x, lift, half * t.y, T(0.0)};
}

}  // namespace
}  // namespace sim_core
