#include "contact/bodies.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>

namespace sim_core {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

Corners at_share(const Corners& start, const Corners& end, double share) {
  Corners out;
  for (int c = 0; c < 3; ++c) out[c] = start[c] + share * (end[c] - start[c]);
  return out;
}

// The share of the displacement at which `f` changes its sign, by bisection; NaN if it has one sign
// at both ends.
template <class F>
double change_of_sign(const F& f) {
  constexpr int halvings = 30;
  double low = 0.0, high = 1.0;
  const bool below = f(low) < 0.0;
  if ((f(high) < 0.0) == below) return std::numeric_limits<double>::quiet_NaN();
  for (int i = 0; i < halvings; ++i) {
    const double middle = 0.5 * (low + high);
    ((f(middle) < 0.0) == below ? low : high) = middle;
  }
  return high;
}

// Whether the inside of the triangle passes a point: where its volume with the point changes its
// sign, the point lies in it.
bool passes_point(const Corners& start, const Corners& end, const Vector3d& point) {
  const double share = change_of_sign([&](double t) {
    const Corners at = at_share(start, end, t);
    return (at[0] - point).dot((at[1] - point).cross(at[2] - point));
  });
  if (std::isnan(share)) return false;
  const Corners at = at_share(start, end, share);
  const Vector3d normal = (at[1] - at[0]).cross(at[2] - at[0]);
  for (int c = 0; c < 3; ++c) {
    if (normal.dot((at[c] - point).cross(at[(c + 1) % 3] - point)) < 0.0) return false;
  }
  return true;
}

// Whether a side of the triangle passes the segment of the core along its axis `along`, at `side`
// of the other one.
bool passes_segment(const Core& core, const Corners& start, const Corners& end, int along,
                    double side) {
  const auto across = [&](const Vector3d& p) { return Vector2d(p[1 - along] - side, p[2]); };
  for (int c = 0; c < 3; ++c) {
    const int d = (c + 1) % 3;
    const double share = change_of_sign([&](double t) {
      const Vector2d a = across(start[c] + t * (end[c] - start[c])),
                     b = across(start[d] + t * (end[d] - start[d]));
      return a.x() * b.y() - a.y() * b.x();
    });
    if (std::isnan(share)) continue;
    const Vector3d p = start[c] + share * (end[c] - start[c]),
                   q = start[d] + share * (end[d] - start[d]);
    const Vector2d a = across(p), b = across(q);
    const double displacement = (a - b).squaredNorm(),
                 place = displacement > 0.0 ? a.dot(a - b) / displacement : 0.0;
    if (place < 0.0 || place > 1.0) continue;
    if (std::abs(p[along] + place * (q[along] - p[along])) <= core.half[along]) return true;
  }
  return false;
}

// Whether a corner of the triangle passes the inside of the rectangle.
bool passes_inside(const Core& core, const Corners& start, const Corners& end) {
  for (int c = 0; c < 3; ++c) {
    if ((start[c].z() < 0.0) == (end[c].z() < 0.0)) continue;
    const Vector3d at = start[c] + start[c].z() / (start[c].z() - end[c].z()) * (end[c] - start[c]);
    if (std::abs(at.x()) < core.half.x() && std::abs(at.y()) < core.half.y()) return true;
  }
  return false;
}

// Where the box from `low` to `high` lies along an axis.
std::array<double, 2> range_along(const Vector3d& axis, const Vector3d& origin, const Vector3d& low,
                                  const Vector3d& high) {
  const double middle = axis.dot(0.5 * (low + high) - origin),
               half = axis.cwiseAbs().dot(0.5 * (high - low));
  return {middle - half, middle + half};
}

// Corners of the core: bit `a` of a corner's number says on which side of axis `a` it lies, where
// the core has one.
MedialAxis medial_axis_of(const std::array<std::array<double, 2>, 3>& core, bool whole) {
  MedialAxis out{};
  std::vector<int> axes;
  for (int a = 0; a < 3; ++a) {
    if (core[a][0] < core[a][1]) axes.push_back(a);
  }
  const int count = 1 << axes.size();
  for (int corner = 0; corner < count; ++corner) {
    Vector3d p(core[0][0], core[1][0], core[2][0]);
    for (std::size_t k = 0; k < axes.size(); ++k) p[axes[k]] = core[axes[k]][corner >> k & 1];
    out.points.push_back(p);
  }
  const int all = static_cast<int>(axes.size());
  for (int corner = 0; corner < count; ++corner) {
    for (int k = 0; k < all; ++k) {
      if (corner >> k & 1) continue;
      const int next = corner | 1 << k;
      out.segments.push_back({corner, next});
      if (whole && all == 1) out.triangles.push_back({corner, next, next});
      for (int l = k + 1; whole && l < all; ++l) {
        if (corner >> l & 1) continue;
        const int other = corner | 1 << l, opposite = next | other;
        out.triangles.push_back({corner, next, opposite});
        out.triangles.push_back({corner, opposite, other});
      }
    }
  }
  return out;
}

}  // namespace

double Body::half_thickness() const {
  return shape == plane ? std::numeric_limits<double>::infinity() : radius + core.minCoeff();
}

Gap gap_of(const Body& body, const Vector3d& x) {
  const Vector3d local = body.rotation.transpose() * (x - body.origin);
  if (body.shape == Body::plane) return {local.z(), body.rotation.col(2), true};
  const Vector3d beyond = local.cwiseAbs() - body.core, outside = beyond.cwiseMax(0.0);
  const double r = outside.norm();
  Vector3d normal = Vector3d::Zero();
  if (r > 0.0) {
    for (int c = 0; c < 3; ++c) normal[c] = std::copysign(outside[c] / r, local[c]);
    return {r - body.radius, body.rotation * normal,
            normal.cwiseAbs().maxCoeff() == 1.0 && body.core.minCoeff() > 0.0};
  }
  int axis = 0;
  beyond.maxCoeff(&axis);
  normal[axis] = std::copysign(1.0, local[axis]);
  return {beyond[axis] - body.radius, body.rotation * normal};
}

// A body is convex, so its distance grows by at least the normal's share of the path from
// the triangle's middle. Where that leaves it open, its quarters are looked at.
double depth_beyond(const Body& body, const std::array<Vector3d, 3>& triangle, double allowed) {
  const auto& [a, b, c] = triangle;
  const Vector3d middle = (a + b + c) / 3.0;
  const Gap gap = gap_of(body, middle);
  if (gap.distance < -allowed) return -gap.distance;
  const double lowest = std::min(
      {gap.normal.dot(a - middle), gap.normal.dot(b - middle), gap.normal.dot(c - middle)});
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

Core core_of(const Body& body) {
  if (body.shape == Body::plane)
    return {std::numeric_limits<double>::infinity(), Vector2d::Zero(), {}};
  int thin = 0, first = 0;
  const double less = body.core.minCoeff(&thin);
  body.core.maxCoeff(&first);
  if (first == thin) first = (thin + 1) % 3;
  const int second = 3 - thin - first;
  Eigen::Matrix3d axes;
  axes << Vector3d::Unit(first), Vector3d::Unit(second), Vector3d::Unit(thin);
  return {body.radius + less, {body.core[first] - less, body.core[second] - less}, axes};
}

bool passes(const Core& core, const Corners& start, const Corners& end) {
  Eigen::AlignedBox3d displacement;
  for (const Corners* at : {&start, &end}) {
    for (const Vector3d& p : *at) displacement.extend(p);
  }
  const Vector3d half(core.half.x(), core.half.y(), 0.0);
  if (!displacement.intersects({-half, half})) return false;
  const bool wide = core.half.y() > 0.0, thin = !(core.half.x() > 0.0) && !wide;
  if (thin) return passes_point(start, end, Vector3d::Zero());
  const auto corners = [&] {
    for (const double u : {-core.half.x(), core.half.x()}) {
      for (const double v : {-core.half.y(), core.half.y()}) {
        if (std::isfinite(u) && passes_point(start, end, {u, v, 0.0})) return true;
      }
    }
    return false;
  };
  for (int along = 0; along < 2; ++along) {
    if (!(core.half[along] > 0.0)) continue;
    for (const double sign : {-1.0, 1.0}) {
      if (passes_segment(core, start, end, along, sign * core.half[1 - along])) return true;
    }
  }
  return corners() || (wide && passes_inside(core, start, end));
}

std::vector<MedialAxis> medial_axes_of(const std::vector<Body>& bodies, double cell,
                                       const Vector3d& low, const Vector3d& high, double beyond,
                                       const CapsuleSettings& settings) {
  std::vector<MedialAxis> out;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    const Body& body = bodies[b];
    if (body.shape == Body::plane || body.radius >= settings.radius_max * cell) continue;
    std::array<std::array<double, 2>, 3> core;
    for (int a = 0; a < 3; ++a) {
      core[a] = {-body.core[a], body.core[a]};
      if (std::isfinite(body.core[a])) continue;
      core[a] = range_along(body.rotation.col(a), body.origin, low, high);
      core[a][0] -= beyond;
      core[a][1] += beyond;
    }
    const bool whole = body.core.minCoeff() + body.radius < settings.thickness_max * cell;
    MedialAxis one = medial_axis_of(core, whole);
    one.body = static_cast<int>(b);
    one.radius = body.radius;
    one.replaces_nodes = whole;
    out.push_back(std::move(one));
  }
  return out;
}

}  // namespace sim_core
