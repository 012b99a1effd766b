#include "contact/pair_law.hpp"

#include <Eigen/Geometry>
#include <algorithm>

#include "cloth/problem.hpp"

namespace sim_core {

using Eigen::Matrix3d;
using Eigen::Vector3d;

namespace {

PairRow open_row(const PairSight& sight) { return {contact_open, Matrix3d::Zero(), Matrix3d::Zero(), -sight.force}; }

PairRow stick_row(const PairSight& sight) {
  const Matrix3d stiffness = sight.proximal * Matrix3d::Identity();
  return {contact_stick, stiffness, stiffness, -sight.proximal * (sight.gap * sight.normal + sight.slip)};
}

PairRow slip_row(const PairSight& sight) {
  const Vector3d& n = sight.normal;
  const double kappa = sight.proximal, k = sight.stiffness, pressing = std::max(sight.force.dot(n), 0.0);
  const Vector3d tangential = sight.force - sight.force.dot(n) * n, tau = tangential - k * sight.slip;
  const double size = tau.norm(), bound = sight.mu * pressing;
  const Vector3d t = size > 0.0 ? Vector3d(tau / size) : Vector3d(n.unitOrthogonal());
  const double beta = size > 0.0 ? std::min(bound / size, 1.0) : 0.0;
  // s = beta k/(1 - beta) and s/(beta k) = 1/(1 - beta), or kappa in place of s.
  const bool soft = beta * k < kappa * (1.0 - beta);
  const double side = soft ? beta * k / (1.0 - beta) : kappa;
  const double pull = soft ? 1.0 / (1.0 - beta) : kappa / (beta * k);
  const Matrix3d across = Matrix3d::Identity() - n * n.transpose() - t * t.transpose();
  const Matrix3d symmetric = kappa * n * n.transpose() + side * across;
  return {contact_slip, symmetric + sight.mu * kappa * t * n.transpose(), symmetric,
          -kappa * sight.gap * n + (bound - t.dot(tangential) - sight.mu * kappa * sight.gap) * t -
              pull * (across * tangential)};
}

}  // namespace

PairRow pair_row(const PairSight& sight) {
  const double pressing = sight.force.dot(sight.normal), bearing = pressing - sight.stiffness * sight.gap;
  if (!(bearing > 0.0)) return open_row(sight);
  const Vector3d tau = sight.force - pressing * sight.normal - sight.stiffness * sight.slip;
  const bool sticks = sight.mu > 0.0 && tau.norm() <= sight.mu * std::max(pressing, bearing);
  return sticks ? stick_row(sight) : slip_row(sight);
}

PairRow closing_row(const PairSight& sight, const Vector3d& motion) {
  const double sinking = sight.normal.dot(motion) + sight.gap;
  PairSight then = sight;
  then.slip += motion - sight.normal.dot(motion) * sight.normal;
  const bool sticks = sight.mu > 0.0 && then.slip.norm() <= sight.mu * std::max(-sinking, 0.0);
  return sticks ? stick_row(sight) : slip_row(then);
}

double pair_error_squared(const PairSight& sight) {
  const double pressing = sight.force.dot(sight.normal);
  const double bearing = std::max(0.0, pressing - sight.stiffness * sight.gap);
  const Vector3d tangential = sight.force - pressing * sight.normal;
  if (!(bearing > 0.0)) return sight.force.squaredNorm();
  const Vector3d tau = tangential - sight.stiffness * sight.slip;
  const double size = tau.norm(), bound = sight.mu * std::max(pressing, 0.0);
  const Vector3d allowed = size > bound ? Vector3d(bound / size * tau) : tau;
  return (pressing - bearing) * (pressing - bearing) + (tangential - allowed).squaredNorm();
}

}  // namespace sim_core
