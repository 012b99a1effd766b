#include "contact/law.hpp"

#include <Eigen/Geometry>
#include <algorithm>

#include "cloth/problem.hpp"

namespace sim_core {

using Eigen::Vector3d;

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

ContactLinearization slipping_row(const ContactKinematics& at, const Vector3d& direction, double turning) {
  const Vector3d& n = at.normal;
  const double pressing = at.force.dot(n), open = at.stiffness * at.gap;
  const Vector3d t = (direction - direction.dot(n) * n).normalized(), tangential = at.force - pressing * n;
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

}  // namespace sim_core
