#include "contact/coulomb_law.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Halvings of an interval of doubles: 53 bits of one, and as many to bracket the root.
constexpr int bisections_max = 100;

// z_N and z_T.
double asked_normal(const Contact& contact) {
  return contact.normal_force() - contact.stiffness * contact.gap;
}
Vector3d asked_friction(const Contact& contact) {
  return contact.friction() - contact.stiffness * contact.slip;
}

Vector3d direction_of(const Vector3d& friction, const Vector3d& normal) {
  const double size = friction.norm();
  return size > 0.0 ? Vector3d(friction / size) : Vector3d(normal.unitOrthogonal());
}

// The root y >= 0 of y (f^2 (1 + y)^2 - s^2) = 2 q (1 + y)^2, with the bound f of friction, s =
// |z_T| and q = k epsilon: then rho = s/(1 + y).
double friction_multiplier(double bound, double size, double q) {
  const auto value = [&](double y) {
    return y * (bound * (1.0 + y) - size) * (bound * (1.0 + y) + size) -
           2.0 * q * (1.0 + y) * (1.0 + y);
  };
  // Below s/f - 1 the left side is not positive. From there the root is bracketed, then bisected.
  double low = std::max(0.0, size / bound - 1.0);
  double high = low + std::sqrt(q) / bound + q / (bound * bound);
  for (int i = 0; i < bisections_max && value(high) < 0.0; ++i) high = low + 2.0 * (high - low);
  for (int i = 0; i < bisections_max; ++i) {
    const double y = 0.5 * (low + high);
    if (y <= low || y >= high) break;
    (value(y) < 0.0 ? low : high) = y;
  }
  return high;
}

}  // namespace

LawResponse sticking(const Contact& contact) {
  const Vector3d friction = asked_friction(contact);
  LawResponse law;
  law.mode = contact_stick;
  law.direction = direction_of(friction, contact.normal);
  law.normal_force = asked_normal(contact);
  law.friction = friction;
  law.bearing_force = std::max(contact.normal_force(), 0.0) + contact.pressed;
  law.derivative = {1.0, 1.0, 1.0, 0.0};
  return law;
}

LawResponse slipping(const Contact& contact) {
  const Vector3d friction = asked_friction(contact);
  const double size = friction.norm();
  LawResponse law;
  law.mode = contact_slip;
  law.direction = direction_of(friction, contact.normal);
  law.normal_force = asked_normal(contact);
  law.bearing_force = std::max(contact.normal_force(), 0.0) + contact.pressed;
  // Here mu enters the law: it bounds friction, and it couples friction to the normal force. How
  // it enters the matrix stands at the head of coulomb_law.hpp.
  const double bound = contact.mu * law.bearing_force;
  law.friction = bound * law.direction;
  law.derivative = {1.0, 0.0, size > 0.0 ? std::min(bound / size, 1.0) : 0.0, contact.mu};
  return law;
}

LawResponse slipping_along(const Contact& contact, const Vector3d& direction,
                           double turn_stiffness) {
  LawResponse law = slipping(contact);
  const Vector3d& n = contact.normal;
  law.direction = (direction - direction.dot(n) * n).normalized();
  // b_s k/(1 - b_s) is the stiffness against a turn.
  law.derivative.across = turn_stiffness / (turn_stiffness + contact.stiffness);
  const Vector3d asked = asked_friction(contact);
  const Vector3d across = asked - law.direction.dot(asked) * law.direction;
  law.friction = contact.mu * law.bearing_force * law.direction + law.derivative.across * across;
  return law;
}

LawResponse coulomb_law(const Contact& contact) {
  const double normal_force = asked_normal(contact);
  if (!(normal_force > 0.0)) return {};
  const double bearing_force = std::max(contact.normal_force(), normal_force) + contact.pressed;
  const bool sticks =
      contact.mu > 0.0 && asked_friction(contact).norm() <= contact.mu * bearing_force;
  return sticks ? sticking(contact) : slipping(contact);
}

LawResponse closing(const Contact& contact, const Vector3d& motion) {
  const double approach = contact.normal.dot(motion);
  Contact closed = contact;
  closed.slip += motion - approach * contact.normal;
  const double sinking = std::max(-(approach + contact.gap), 0.0);
  const bool sticks = contact.mu > 0.0 && closed.slip.norm() <= contact.mu * sinking;
  return sticks ? sticking(contact) : slipping(closed);
}

LawResponse smoothed_law(const Contact& contact, double epsilon) {
  const double q = contact.stiffness * epsilon;
  const double asked = asked_normal(contact);
  const double root = std::sqrt(asked * asked + 4.0 * q);
  LawResponse law;
  // Of the two forms of the root, the one in which no digits cancel.
  law.normal_force = asked > 0.0 ? 0.5 * (asked + root) : 2.0 * q / (root - asked);
  law.bearing_force = law.normal_force;
  law.derivative.normal = law.normal_force / root;

  const Vector3d friction = asked_friction(contact);
  const double size = friction.norm();
  const double bound = contact.mu * law.bearing_force;
  law.direction = direction_of(friction, contact.normal);
  law.mode = contact_slip;
  if (!(bound > 0.0)) return law;
  const double y = friction_multiplier(bound, size, q);
  law.derivative.across = 1.0 / (1.0 + y);
  const double rho = size * law.derivative.across;
  law.friction = rho * law.direction;
  law.derivative.along = 1.0 / (1.0 + y * y * (bound * bound + rho * rho) / (2.0 * q));
  // drho/d(mu P_N), times mu.
  law.derivative.coupling = contact.mu * law.derivative.along * rho * bound * y * y / q;
  if (law.derivative.along > 0.5) law.mode = contact_stick;
  return law;
}

double missed_squared(const Contact& contact, const LawResponse& law) {
  const double size = law.friction.norm();
  const double bound = contact.mu * law.bearing_force;
  // A contact that sinks in may stick with more than its bound: the law asks for no more.
  const double friction_scale = size > bound ? bound / size : 1.0;
  const double normal = contact.normal_force() - law.normal_force;
  return normal * normal + (contact.friction() - friction_scale * law.friction).squaredNorm();
}

double missed_squared(const Contact& contact, double epsilon) {
  return missed_squared(contact,
                        epsilon > 0.0 ? smoothed_law(contact, epsilon) : coulomb_law(contact));
}

}  // namespace sim_core
