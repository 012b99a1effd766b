#include "contact/law.hpp"

#include <Eigen/Geometry>
#include <algorithm>

#include "cloth/problem.hpp"

namespace sim_core {

using Eigen::Vector3d;

namespace {

// Slip below this share of the friction force is as good as stuck for the factor.
constexpr double turning_max = 1e3;

}  // namespace

ContactRow open_row(const Vector3d& force) {
  return {contact_open, Vector3d::Zero(), -force, Vector3d::Zero(), 0.0, 0.0, force.squaredNorm()};
}

ContactRow closed_row(const ContactSight& sight) {
  const Vector3d& n = sight.normal;
  const double k = sight.stiffness, pressing = sight.force.dot(n);
  const Vector3d tangential = sight.force - pressing * n;
  const double bound = sight.mu * std::max(pressing, 0.0);
  const Vector3d tau = tangential - k * sight.slip;
  const double size = tau.norm(), open = k * sight.gap;
  if (size <= bound && bound > 0.0) return sticking_row(sight);
  const Vector3d t = size > 0.0 ? Vector3d(tau / size) : Vector3d(n.unitOrthogonal());
  const double along = t.dot(tangential) - bound;
  const Vector3d across = tangential - t.dot(tangential) * t;
  const double scale = size - bound > size / turning_max ? size / (size - bound) : turning_max;
  return {contact_slip,
          t,
          -along * t - scale * across,
          -sight.gap * n,
          pressing > 0.0 ? sight.mu : 0.0,
          size > 0.0 ? scale * bound / size * k : 0.0,
          open * open + (tangential - bound * t).squaredNorm()};
}

ContactRow sticking_row(const ContactSight& sight) {
  const double open = sight.stiffness * sight.gap;
  return {contact_stick,
          Vector3d::Zero(),
          Vector3d::Zero(),
          -sight.gap * sight.normal - sight.slip,
          0.0,
          0.0,
          open * open + sight.stiffness * sight.stiffness * sight.slip.squaredNorm()};
}

ContactRow slipping_row(const ContactSight& sight, const Vector3d& direction, double turning) {
  const Vector3d& n = sight.normal;
  const double pressing = sight.force.dot(n), open = sight.stiffness * sight.gap;
  const Vector3d t = (direction - direction.dot(n) * n).normalized(), tangential = sight.force - pressing * n;
  const double along = t.dot(tangential) - sight.mu * pressing;
  const Vector3d across = tangential + turning * sight.slip;
  return {contact_slip,
          t,
          -along * t - (across - t.dot(across) * t),
          -sight.gap * n,
          sight.mu,
          turning,
          open * open + (tangential - sight.mu * pressing * t).squaredNorm()};
}

}  // namespace sim_core
