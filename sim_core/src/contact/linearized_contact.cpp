#include "contact/linearized_contact.hpp"

#include <algorithm>

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Pairs whose stiffness is below this fraction of k are left out of the matrix: that is the
// tolerance of GMRES with pairs.
constexpr double negligible_stiffness = 1e-4;

}  // namespace

NodeRow node_row(const Contact& contact, const LawResponse& law, double turn_stiffness_max) {
  NodeRow row;
  row.mode = law.mode;
  // Open: the node's force goes, in all directions.
  if (law.mode == contact_open) {
    row.force = -contact.force;
    return row;
  }
  // Stick: all directions are prescribed.
  if (law.mode == contact_stick) {
    row.correction = -contact.gap * contact.normal - contact.slip;
    return row;
  }
  // Slip: the normal direction is prescribed. Along t the force goes to the bound at the new normal
  // force; across t it goes to 0 against the stiffness of turning.
  const Vector3d& t = law.direction;
  const LawDerivative& d = law.derivative;
  row.direction = t;
  row.correction = -contact.gap * contact.normal;
  row.coupling = d.coupling;
  const double freedom = 1.0 - d.across;
  const double scale = freedom * turn_stiffness_max > 1.0 ? 1.0 / freedom : turn_stiffness_max;
  row.turn_stiffness = scale * d.across * contact.stiffness;
  const Vector3d lacking = law.friction - contact.friction();
  const double bearing_force = contact.normal_force() + contact.pressed;
  const double along = t.dot(lacking) + d.coupling * (bearing_force - law.bearing_force);
  row.force = along * t + scale * (lacking - t.dot(lacking) * t);
  return row;
}

PairRow pair_row(const Contact& contact, const LawResponse& law,
                 const ProximalStiffness& proximal) {
  const Vector3d& n = contact.normal;
  const Vector3d& t = law.direction;
  const LawDerivative& d = law.derivative;
  const double k = contact.stiffness;
  const double normal_force = contact.normal_force();
  const Vector3d friction = contact.friction();
  PairRow row;
  if (law.mode == contact_open) {
    row.force = -contact.force;
    return row;
  }
  // s, the compliance in each direction.
  const auto compliance = [&](double derivative, double kappa) {
    return (1.0 - derivative) / k + derivative / kappa;
  };
  const double s_n = compliance(d.normal, proximal.normal);
  const double s_t = compliance(d.along, proximal.tangential);
  const double s_s = compliance(d.across, proximal.tangential);

  // The normal force first: its change enters the bound of friction.
  const double normal_stiffness = d.normal / s_n;
  const double normal_change = (law.normal_force - normal_force) / (k * s_n);
  const double coupling = d.coupling / (k * s_t);
  const double bound_change = normal_force + normal_change - law.bearing_force;

  const Matrix3d side = Matrix3d::Identity() - n * n.transpose() - t * t.transpose();
  const Vector3d lacking = law.friction - friction;
  row.force = normal_change * n + (t.dot(lacking) / (k * s_t) + coupling * bound_change) * t +
              side * lacking / (k * s_s);
  if (d.normal < negligible_stiffness) return row;

  row.mode = law.mode;
  row.symmetric = normal_stiffness * n * n.transpose() + d.along / s_t * t * t.transpose() +
                  d.across / s_s * side;
  row.stiffness = row.symmetric + coupling * normal_stiffness * t * n.transpose();
  // As the normal turns, so does the plane of friction. A contact that sticks holds its force.
  row.force_by_normal = normal_force * ((1.0 - d.along) / (k * s_t) * t * t.transpose() +
                                        (1.0 - d.across) / (k * s_s) * side) +
                        coupling * t * friction.transpose();
  return row;
}

}  // namespace sim_core
