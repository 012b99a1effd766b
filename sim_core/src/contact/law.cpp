#include "contact/law.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "contact/rows.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

PairLinearization open_row(const PairKinematics& at) {
  return {contact_open, Matrix3d::Zero(), Matrix3d::Zero(), -at.force};
}

PairLinearization stick_row(const PairKinematics& at) {
  const Vector3d& n = at.normal;
  const Matrix3d stiffness =
      at.across * Matrix3d::Identity() + (at.along - at.across) * n * n.transpose();
  return {contact_stick, stiffness, stiffness, -at.along * at.gap * n - at.across * at.slip};
}

PairLinearization slip_row(const PairKinematics& at) {
  const Vector3d& n = at.normal;
  const double kappa = at.along, lambda = at.across, k = at.stiffness;
  const double pressing = std::max(at.force.dot(n), 0.0);
  const Vector3d tangential = at.force - at.force.dot(n) * n, tau = tangential - k * at.slip;
  const double size = tau.norm(), bound = at.mu * pressing;
  const Vector3d t = size > 0.0 ? Vector3d(tau / size) : Vector3d(n.unitOrthogonal());
  const double beta = size > 0.0 ? std::min(bound / size, 1.0) : 0.0;
  // s = beta k/(1 - beta) and s/(beta k) = 1/(1 - beta), or lambda in place of s.
  const bool soft = beta * k < lambda * (1.0 - beta);
  const double side = soft ? beta * k / (1.0 - beta) : lambda;
  const double pull = soft ? 1.0 / (1.0 - beta) : lambda / (beta * k);
  const Matrix3d across = Matrix3d::Identity() - n * n.transpose() - t * t.transpose();
  const Matrix3d symmetric = kappa * n * n.transpose() + side * across;
  const double turns = soft ? 1.0 : (1.0 - beta) * pull;
  return {contact_slip, symmetric + at.mu * kappa * t * n.transpose(), symmetric,
          -kappa * at.gap * n + (bound - t.dot(tangential) - at.mu * kappa * at.gap) * t -
              pull * (across * tangential),
          pressing * (t * t.transpose() + turns * across) + at.mu * t * tangential.transpose()};
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

// Halvings of an interval of doubles: 53 bits of one, and as many to bracket the root.
constexpr int bisections_max = 100;
// Pairs whose stiffness is below this share of k are left out of the matrix: that is the tolerance
// of GMRES with pairs.
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

Smoothed smoothed(const PairKinematics& at) {
  const Vector3d& n = at.normal;
  const double k = at.stiffness, q = k * at.smoothing, pressing = at.force.dot(n);
  const double z = pressing - k * at.gap, root = std::sqrt(z * z + 4.0 * q);
  Smoothed out{};
  out.pressing = z > 0.0 ? 0.5 * (z + root) : 2.0 * q / (root - z);
  out.share = out.pressing / root;
  const Vector3d tau = at.force - pressing * n - k * at.slip;
  const double size = tau.norm(), bound = at.mu * out.pressing;
  out.direction = size > 0.0 ? Vector3d(tau / size) : Vector3d(n.unitOrthogonal());
  if (!(bound > 0.0)) return out;
  const double y = multiplier(bound, size, q);
  out.across = 1.0 / (1.0 + y);
  out.friction = size * out.across;
  out.along = 1.0 / (1.0 + y * y * (bound * bound + out.friction * out.friction) / (2.0 * q));
  out.by_bound = out.along * out.friction * bound * y * y / q;
  return out;
}

PairLinearization smoothed_row(const PairKinematics& at) {
  const Smoothed law = smoothed(at);
  const Vector3d &n = at.normal, &t = law.direction;
  const double k = at.stiffness, pressing = at.force.dot(n);
  const Vector3d tangential = at.force - pressing * n;
  const auto compliance = [&](double share, double proximal) {
    return (1.0 - share) / k + share / proximal;
  };
  // dr_N = pull - press dg; then friction, of the bound mu (r_N + dr_N).
  const double soft = compliance(law.share, at.along), press = law.share / soft,
               pull = -(pressing - law.pressing) / (k * soft);
  const double soft_along = compliance(law.along, at.across),
               soft_across = compliance(law.across, at.across);
  const double along = law.along / soft_along, across = law.across / soft_across;
  const double coupling = law.by_bound * at.mu / (k * soft_along);
  const Matrix3d side = Matrix3d::Identity() - n * n.transpose() - t * t.transpose();
  const Matrix3d symmetric = press * n * n.transpose() + along * t * t.transpose() + across * side;
  const Vector3d force = pull * n +
                         (coupling * (pressing + pull - law.pressing) -
                          (t.dot(tangential) - law.friction) / (k * soft_along)) *
                             t -
                         side * tangential / (k * soft_across);
  if (law.share < share_least) return {contact_open, Matrix3d::Zero(), Matrix3d::Zero(), force};
  return {law.along > 0.5 ? contact_stick : contact_slip,
          symmetric + coupling * press * t * n.transpose(), symmetric, force,
          pressing * ((1.0 - law.along) / (k * soft_along) * t * t.transpose() +
                      (1.0 - law.across) / (k * soft_across) * side) +
              coupling * t * tangential.transpose()};
}

double smoothed_error_squared(const PairKinematics& at) {
  const Smoothed law = smoothed(at);
  return (at.force - law.pressing * at.normal - law.friction * law.direction).squaredNorm();
}

}  // namespace

ContactLinearization open_row(const Vector3d& force) {
  return {contact_open, Vector3d::Zero(), -force, Vector3d::Zero(), 0.0, 0.0, force.squaredNorm()};
}

ContactLinearization closed_row(const ContactKinematics& at, double turning_max) {
  const Vector3d& n = at.normal;
  const double k = at.stiffness, pressing = at.force.dot(n);
  const Vector3d tangential = at.force - pressing * n;
  const double bound = at.mu * std::max(pressing, 0.0);
  const Vector3d tau = tangential - k * at.slip;
  const double size = tau.norm(), open = k * at.gap;
  if (size <= bound && bound > 0.0) return sticking_row(at);
  const Vector3d t = size > 0.0 ? Vector3d(tau / size) : Vector3d(n.unitOrthogonal());
  const double along = t.dot(tangential) - bound;
  const Vector3d across = tangential - t.dot(tangential) * t;
  const double scale = size - bound > size / turning_max ? size / (size - bound) : turning_max;
  return {contact_slip,
          t,
          -along * t - scale * across,
          -at.gap * n,
          pressing > 0.0 ? at.mu : 0.0,
          size > 0.0 ? scale * bound / size * k : 0.0,
          open * open + (tangential - bound * t).squaredNorm()};
}

ContactLinearization sticking_row(const ContactKinematics& at) {
  const double open = at.stiffness * at.gap;
  return {contact_stick,
          Vector3d::Zero(),
          Vector3d::Zero(),
          -at.gap * at.normal - at.slip,
          0.0,
          0.0,
          open * open + at.stiffness * at.stiffness * at.slip.squaredNorm()};
}

ContactLinearization slipping_row(const ContactKinematics& at, const Vector3d& direction,
                                  double turning) {
  const Vector3d& n = at.normal;
  const double pressing = at.force.dot(n), open = at.stiffness * at.gap;
  const Vector3d t = (direction - direction.dot(n) * n).normalized(),
                 tangential = at.force - pressing * n;
  const double along = t.dot(tangential) - at.mu * pressing;
  const Vector3d across = tangential + turning * at.slip;
  return {contact_slip,
          t,
          -along * t - (across - t.dot(across) * t),
          -at.gap * n,
          at.mu,
          turning,
          open * open + (tangential - at.mu * pressing * t).squaredNorm()};
}

PairLinearization linearize(const PairKinematics& at) {
  if (at.smoothing > 0.0) return smoothed_row(at);
  const double pressing = at.force.dot(at.normal), bearing = pressing - at.stiffness * at.gap;
  if (!(bearing > 0.0)) return open_row(at);
  const Vector3d tau = at.force - pressing * at.normal - at.stiffness * at.slip;
  const bool sticks = at.mu > 0.0 && tau.norm() <= at.mu * std::max(pressing, bearing);
  return sticks ? stick_row(at) : slip_row(at);
}

PairLinearization linearize_closing(const PairKinematics& at, const Vector3d& motion) {
  const double sinking = at.normal.dot(motion) + at.gap;
  PairKinematics then = at;
  then.slip += motion - at.normal.dot(motion) * at.normal;
  const bool sticks = at.mu > 0.0 && then.slip.norm() <= at.mu * std::max(-sinking, 0.0);
  return sticks ? stick_row(at) : slip_row(then);
}

double pair_error_squared(const PairKinematics& at) {
  if (at.smoothing > 0.0) return smoothed_error_squared(at);
  const double pressing = at.force.dot(at.normal);
  const double bearing = std::max(0.0, pressing - at.stiffness * at.gap);
  const Vector3d tangential = at.force - pressing * at.normal;
  if (!(bearing > 0.0)) return at.force.squaredNorm();
  const Vector3d tau = tangential - at.stiffness * at.slip;
  const double size = tau.norm(), bound = at.mu * std::max(pressing, 0.0);
  const Vector3d allowed = size > bound ? Vector3d(bound / size * tau) : tau;
  return (pressing - bearing) * (pressing - bearing) + (tangential - allowed).squaredNorm();
}

}  // namespace sim_core
