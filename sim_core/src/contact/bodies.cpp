#include "contact/bodies.hpp"

#include <Eigen/Geometry>
#include <algorithm>
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

// A body is convex, so its distance grows by at least the normal's share of the way from the triangle's middle. Where
// that leaves it open, its quarters are looked at.
double depth_beyond(const Body& body, const std::array<Vector3d, 3>& triangle, double allowed) {
  const auto& [a, b, c] = triangle;
  const Vector3d middle = (a + b + c) / 3.0;
  const Gap gap = gap_of(body, middle);
  if (gap.distance < -allowed) return -gap.distance;
  const double lowest = std::min({gap.normal.dot(a - middle), gap.normal.dot(b - middle), gap.normal.dot(c - middle)});
  constexpr double error = 1e-6;  // m
  if (!(gap.distance + lowest < -allowed - error)) return 0.0;
  const Vector3d ab = 0.5 * (a + b), bc = 0.5 * (b + c), ca = 0.5 * (c + a);
  for (const auto& quarter : {std::array{ab, bc, ca}, {a, ab, ca}, {ab, b, bc}, {ca, bc, c}}) {
    const double depth = depth_beyond(body, quarter, allowed);
    if (depth > 0.0) return depth;
  }
  return 0.0;
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
