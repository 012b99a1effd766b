#include "contact/closest.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <utility>

namespace sim_core {

using Eigen::Vector3d;
using Eigen::Vector4d;

namespace {

// Squared sine below which segments count as parallel: the determinant a e - b b then has lost all but 2 of 16 digits.
constexpr double parallel = 1e-14;
// Bounds the work where pieces slide past each other much slower than the bound of their speed.
constexpr int advances_max = 1000;

Eigen::Vector2d closest_on_segments(const FourPoints& x) {
  const Vector3d u = x[1] - x[0], v = x[3] - x[2], r = x[0] - x[2];
  const double a = u.squaredNorm(), e = v.squaredNorm(), b = u.dot(v), c = u.dot(r), f = v.dot(r);
  const double denominator = a * e - b * b;
  double s = denominator > parallel * a * e ? std::clamp((b * f - c * e) / denominator, 0.0, 1.0) : 0.0;
  double t = e > 0.0 ? (b * s + f) / e : 0.0;
  if (t < 0.0 || t > 1.0) {
    t = std::clamp(t, 0.0, 1.0);
    s = a > 0.0 ? std::clamp((b * t - c) / a, 0.0, 1.0) : 0.0;
  }
  return {s, t};
}

}  // namespace

Vector3d closest_on_triangle(const Vector3d& p, const Vector3d& a, const Vector3d& b, const Vector3d& c) {
  const Vector3d ab = b - a, ac = c - a, ap = p - a;
  const double d1 = ab.dot(ap), d2 = ac.dot(ap);
  if (d1 <= 0.0 && d2 <= 0.0) return {1.0, 0.0, 0.0};
  const Vector3d bp = p - b;
  const double d3 = ab.dot(bp), d4 = ac.dot(bp);
  if (d3 >= 0.0 && d4 <= d3) return {0.0, 1.0, 0.0};
  const double vc = d1 * d4 - d3 * d2;
  if (vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0) {
    const double v = d1 / (d1 - d3);
    return {1.0 - v, v, 0.0};
  }
  const Vector3d cp = p - c;
  const double d5 = ab.dot(cp), d6 = ac.dot(cp);
  if (d6 >= 0.0 && d5 <= d6) return {0.0, 0.0, 1.0};
  const double vb = d5 * d2 - d1 * d6;
  if (vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0) {
    const double w = d2 / (d2 - d6);
    return {1.0 - w, 0.0, w};
  }
  const double va = d3 * d6 - d5 * d4;
  if (va <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0) {
    const double w = (d4 - d3) / ((d4 - d3) + (d5 - d6));
    return {0.0, 1.0 - w, w};
  }
  const double sum = va + vb + vc;
  return {1.0 - vb / sum - vc / sum, vb / sum, vc / sum};
}

Vector4d closest_weights(PairKind kind, const FourPoints& x) {
  if (kind == PairKind::vertex_triangle) {
    const Vector3d b = closest_on_triangle(x[0], x[1], x[2], x[3]);
    return {1.0, -b[0], -b[1], -b[2]};
  }
  const Eigen::Vector2d at = closest_on_segments(x);
  return {1.0 - at[0], at[0], at[1] - 1.0, -at[1]};
}

double crossing_squared(const FourPoints& x) {
  const Vector3d u = x[1] - x[0], v = x[3] - x[2];
  return u.cross(v).squaredNorm() / (u.squaredNorm() * v.squaredNorm());
}

double Leaves::of(double distance) const {
  return std::max(share * std::min(distance, most), std::min(distance, floor));
}

double safe_share(PairKind kind, const FourPoints& x, const FourPoints& to, const Leaves& leaves) {
  FourPoints at = x, motion;
  Vector3d mean = Vector3d::Zero();
  for (int i = 0; i < 4; ++i) mean += 0.25 * (to[i] - x[i]);
  std::array<double, 4> speed;
  for (int i = 0; i < 4; ++i) {
    motion[i] = to[i] - x[i] - mean;
    speed[i] = motion[i].norm();
  }
  // No distance of a point here from a point there shrinks faster.
  const double fastest = kind == PairKind::vertex_triangle
                             ? speed[0] + std::max({speed[1], speed[2], speed[3]})
                             : std::max(speed[0], speed[1]) + std::max(speed[2], speed[3]);
  double distance = between_closest(closest_weights(kind, x), x).norm();
  const double least = leaves.of(distance);
  if (fastest <= distance - least) return 1.0;
  if (!(distance > 0.0) || !std::isfinite(fastest)) return 0.0;
  double share = 0.0;
  for (int k = 0; k < advances_max; ++k) {
    // The distance is at least `least` up to here, and above 0 up to `next`.
    const double safe = share + (distance - least) / fastest;
    if (safe >= 1.0) return 1.0;
    const double next = std::min(1.0, share + std::max((1.0 - leaves.rest) * distance, distance - least) / fastest);
    for (int i = 0; i < 4; ++i) at[i] = x[i] + next * motion[i];
    const double before = std::exchange(distance, between_closest(closest_weights(kind, at), at).norm());
    if (distance < least) return share + (before - least) / fastest;
    if (next == 1.0) return 1.0;
    share = next;
  }
  return share;
}

}  // namespace sim_core
