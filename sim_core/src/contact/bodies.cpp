#include "contact/bodies.hpp"

#include <Eigen/Geometry>
#include <cmath>
#include <limits>

namespace sim_core {

using Eigen::Vector3d;

double Body::half_thickness() const {
  return shape == plane ? std::numeric_limits<double>::infinity() : radius + core.minCoeff();
}

Gap gap_of(const Body& body, const Vector3d& x) {
  const Vector3d local = body.rotation.transpose() * (x - body.origin);
  if (body.shape == Body::plane) return {local.z(), body.rotation.col(2)};
  const Vector3d beyond = local.cwiseAbs() - body.core, outside = beyond.cwiseMax(0.0);
  const double r = outside.norm();
  Vector3d normal = Vector3d::Zero();
  if (r > 0.0) {
    for (int c = 0; c < 3; ++c) normal[c] = std::copysign(outside[c] / r, local[c]);
    return {r - body.radius, body.rotation * normal};
  }
  int axis = 0;
  beyond.maxCoeff(&axis);
  normal[axis] = std::copysign(1.0, local[axis]);
  return {beyond[axis] - body.radius, body.rotation * normal};
}

Vector3d carried(const Body& begin, const Body& end, const Vector3d& x) {
  return end.origin + end.rotation * (begin.rotation.transpose() * (x - begin.origin));
}

Body between(const Body& a, const Body& b, double share) {
  Body out = b;
  out.origin = a.origin + share * (b.origin - a.origin);
  if (a.rotation != b.rotation) {
    const Eigen::Quaterniond p(a.rotation), q(b.rotation);
    out.rotation = p.slerp(share, q).toRotationMatrix();
  }
  return out;
}

}  // namespace sim_core
