#include "contact/pair_law.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "cloth/problem.hpp"

namespace sim_core {

using Eigen::Matrix3d;
using Eigen::Vector3d;

namespace {

PairRow open_row(const PairSight& sight) { return {contact_open, Matrix3d::Zero(), Matrix3d::Zero(), -sight.force}; }

PairRow stick_row(const PairSight& sight) {
  const Vector3d& n = sight.normal;
  const Matrix3d stiffness = sight.across * Matrix3d::Identity() + (sight.along - sight.across) * n * n.transpose();
  return {contact_stick, stiffness, stiffness, -sight.along * sight.gap * n - sight.across * sight.slip};
}

PairRow slip_row(const PairSight& sight) {
  const Vector3d& n = sight.normal;
  const double kappa = sight.along, lambda = sight.across, k = sight.stiffness;
  const double pressing = std::max(sight.force.dot(n), 0.0);
  const Vector3d tangential = sight.force - sight.force.dot(n) * n, tau = tangential - k * sight.slip;
  const double size = tau.norm(), bound = sight.mu * pressing;
  const Vector3d t = size > 0.0 ? Vector3d(tau / size) : Vector3d(n.unitOrthogonal());
  const double beta = size > 0.0 ? std::min(bound / size, 1.0) : 0.0;
  // s = beta k/(1 - beta) and s/(beta k) = 1/(1 - beta), or lambda in place of s.
  const bool soft = beta * k < lambda * (1.0 - beta);
  const double side = soft ? beta * k / (1.0 - beta) : lambda;
  const double pull = soft ? 1.0 / (1.0 - beta) : lambda / (beta * k);
  const Matrix3d across = Matrix3d::Identity() - n * n.transpose() - t * t.transpose();
  const Matrix3d symmetric = kappa * n * n.transpose() + side * across;
  const double turns = soft ? 1.0 : (1.0 - beta) * pull;
  return {contact_slip, symmetric + sight.mu * kappa * t * n.transpose(), symmetric,
          -kappa * sight.gap * n + (bound - t.dot(tangential) - sight.mu * kappa * sight.gap) * t -
              pull * (across * tangential),
          pressing * (t * t.transpose() + turns * across) + sight.mu * t * tangential.transpose()};
}

// The smoothed law at a pair: what it asks of the force, and its derivatives.
struct Smoothed {
  double pressing;       // R_N, N
  double share;          // dR_N/d(r_N - k g)
  Vector3d direction;    // t
  double friction;       // rho, N
  double along, across;  // drho/d|tau|, rho/|tau|
  double by_bound;       // drho/d(mu R_N)
};

constexpr int bisections_max = 100;
// Pairs that give way by less than this share of k are left out of the matrix.
constexpr double share_least = 1e-4;

// y >= 0 with y (f^2 (1 + y)^2 - a^2) = 2 q (1 + y)^2: then rho = a/(1 + y).
double multiplier(double f, double a, double q) {
  const auto value = [&](double y) {
    return y * (f * (1.0 + y) - a) * (f * (1.0 + y) + a) - 2.0 * q * (1.0 + y) * (1.0 + y);
  };
  double low = std::max(0.0, a / f - 1.0), high = low + std::sqrt(q) / f + q / (f * f);
  for (int i = 0; i < bisections_max && value(high) < 0.0; ++i) high = low + 2.0 * (high - low);
  for (int i = 0; i < bisections_max; ++i) {
    const double y = 0.5 * (low + high);
    if (y <= low || y >= high) break;
    (value(y) < 0.0 ? low : high) = y;
  }
  return high;
}

Smoothed smoothed(const PairSight& sight) {
  const Vector3d& n = sight.normal;
  const double k = sight.stiffness, q = k * sight.smoothing, pressing = sight.force.dot(n);
  const double z = pressing - k * sight.gap, root = std::sqrt(z * z + 4.0 * q);
  Smoothed out{};
  out.pressing = z > 0.0 ? 0.5 * (z + root) : 2.0 * q / (root - z);
  out.share = out.pressing / root;
  const Vector3d tau = sight.force - pressing * n - k * sight.slip;
  const double size = tau.norm(), bound = sight.mu * out.pressing;
  out.direction = size > 0.0 ? Vector3d(tau / size) : Vector3d(n.unitOrthogonal());
  if (!(bound > 0.0)) return out;
  const double y = multiplier(bound, size, q);
  out.across = 1.0 / (1.0 + y);
  out.friction = size * out.across;
  out.along = 1.0 / (1.0 + y * y * (bound * bound + out.friction * out.friction) / (2.0 * q));
  out.by_bound = out.along * out.friction * bound * y * y / q;
  return out;
}

PairRow smoothed_row(const PairSight& sight) {
  const Smoothed law = smoothed(sight);
  const Vector3d &n = sight.normal, &t = law.direction;
  const double k = sight.stiffness, pressing = sight.force.dot(n);
  const Vector3d tangential = sight.force - pressing * n;
  const auto compliance = [&](double share, double proximal) { return (1.0 - share) / k + share / proximal; };
  // dr_N = pull - press dg; then friction, of the bound mu (r_N + dr_N).
  const double soft = compliance(law.share, sight.along), press = law.share / soft,
               pull = -(pressing - law.pressing) / (k * soft);
  const double soft_along = compliance(law.along, sight.across), soft_across = compliance(law.across, sight.across);
  const double along = law.along / soft_along, across = law.across / soft_across;
  const double coupling = law.by_bound * sight.mu / (k * soft_along);
  const Matrix3d side = Matrix3d::Identity() - n * n.transpose() - t * t.transpose();
  const Matrix3d symmetric = press * n * n.transpose() + along * t * t.transpose() + across * side;
  const Vector3d force =
      pull * n +
      (coupling * (pressing + pull - law.pressing) - (t.dot(tangential) - law.friction) / (k * soft_along)) * t -
      side * tangential / (k * soft_across);
  if (law.share < share_least) return {contact_open, Matrix3d::Zero(), Matrix3d::Zero(), force};
  return {law.along > 0.5 ? contact_stick : contact_slip, symmetric + coupling * press * t * n.transpose(), symmetric,
          force,
          pressing * ((1.0 - law.along) / (k * soft_along) * t * t.transpose() +
                      (1.0 - law.across) / (k * soft_across) * side) +
              coupling * t * tangential.transpose()};
}

double smoothed_error_squared(const PairSight& sight) {
  const Smoothed law = smoothed(sight);
  return (sight.force - law.pressing * sight.normal - law.friction * law.direction).squaredNorm();
}

}  // namespace

PairRow pair_row(const PairSight& sight) {
  if (sight.smoothing > 0.0) return smoothed_row(sight);
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
  if (sight.smoothing > 0.0) return smoothed_error_squared(sight);
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
