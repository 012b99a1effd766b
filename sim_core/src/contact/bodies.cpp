#include "contact/bodies.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>

#include "math/refusal.hpp"

namespace sim_core {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

Corners at_fraction(const Corners& start, const Corners& end, double fraction) {
  Corners out;
  for (int c = 0; c < 3; ++c) out[c] = start[c] + fraction * (end[c] - start[c]);
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
  const double fraction = change_of_sign([&](double t) {
    const Corners at = at_fraction(start, end, t);
    return (at[0] - point).dot((at[1] - point).cross(at[2] - point));
  });
  if (std::isnan(fraction)) return false;
  const Corners at = at_fraction(start, end, fraction);
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
    const double fraction = change_of_sign([&](double t) {
      const Vector2d a = across(start[c] + t * (end[c] - start[c])),
                     b = across(start[d] + t * (end[d] - start[d]));
      return a.x() * b.y() - a.y() * b.x();
    });
    if (std::isnan(fraction)) continue;
    const Vector3d p = start[c] + fraction * (end[c] - start[c]),
                   q = start[d] + fraction * (end[d] - start[d]);
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

Vector3d carried(const Body& begin, const Body& end, const Vector3d& x) {
  return end.origin + end.rotation * (begin.rotation.transpose() * (x - begin.origin));
}

Body between(const Body& a, const Body& b, double fraction) {
  Body out = b;
  out.origin = a.origin + fraction * (b.origin - a.origin);
  if (a.rotation != b.rotation) {
    const Eigen::Quaterniond p(a.rotation), q(b.rotation);
    out.rotation = p.slerp(fraction, q).toRotationMatrix();
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

namespace {

// Whether a triangle passes a corner of a rectangle.
bool passes_corners(const Core& core, const Corners& start, const Corners& end) {
  for (const double u : {-core.half.x(), core.half.x()}) {
    for (const double v : {-core.half.y(), core.half.y()}) {
      if (std::isfinite(u) && passes_point(start, end, {u, v, 0.0})) return true;
    }
  }
  return false;
}

bool passes_sides(const Core& core, const Corners& start, const Corners& end) {
  for (int along = 0; along < 2; ++along) {
    if (!(core.half[along] > 0.0)) continue;
    for (const double sign : {-1.0, 1.0}) {
      if (passes_segment(core, start, end, along, sign * core.half[1 - along])) return true;
    }
  }
  return false;
}

}  // namespace

bool passes(const Core& core, const Corners& start, const Corners& end) {
  Eigen::AlignedBox3d displacement;
  for (const Corners* at : {&start, &end}) {
    for (const Vector3d& p : *at) displacement.extend(p);
  }
  const Vector3d half(core.half.x(), core.half.y(), 0.0);
  if (!displacement.intersects({-half, half})) return false;
  const bool wide = core.half.y() > 0.0, thin = !(core.half.x() > 0.0) && !wide;
  if (thin) return passes_point(start, end, Vector3d::Zero());
  return passes_sides(core, start, end) || passes_corners(core, start, end) ||
         (wide && passes_inside(core, start, end));
}

void refuse_sharp(const std::vector<Body>& bodies, double cell) {
  // A radius may be computed from the same cell by other roundings.
  constexpr double slack = 1e-9;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    const Body& body = bodies[b];
    if (body.shape == Body::plane || body.radius >= (1.0 - slack) * radius_least * cell) continue;
    refuse(text("bodies: must have a radius of ", radius_least, " cells of the cloth or more, ",
                1e3 * radius_least * cell, " mm, and body ", b, " has ", 1e3 * body.radius,
                " mm: give a finer cloth"));
  }
}

}  // namespace sim_core
