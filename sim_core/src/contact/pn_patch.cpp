#include "contact/pn_patch.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <utility>

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Newton's method for a foot ends at changes of its barycentric coordinates that square to below rounding. More
// iterations than these mean that there is no foot.
constexpr int iterations_max = 12;
constexpr double converged = 1e-12;

}  // namespace

Vector3d PNPatch::y(const Vector3d& b) const {
  Vector3d out = 6.0 * b[0] * b[1] * b[2] * middle;
  for (int k = 0; k < 3; ++k) {
    const double i = b[next(k)], j = b[after_next(k)];
    out += b[k] * b[k] * b[k] * corner[k] + 3.0 * i * j * (i * near[k] + j * far[k]);
  }
  return out;
}

Vector3d PNPatch::n(const Vector3d& b) const {
  Vector3d out = Vector3d::Zero();
  for (int k = 0; k < 3; ++k) out += b[k] * b[k] * normal[k] + 2.0 * b[next(k)] * b[after_next(k)] * bend[k];
  return out;
}

Matrix3d PNPatch::dy(const Vector3d& b) const {
  Matrix3d out;
  for (int k = 0; k < 3; ++k) {
    out.col(k) = 3.0 * b[k] * b[k] * corner[k] + 6.0 * b[next(k)] * b[after_next(k)] * middle;
  }
  for (int k = 0; k < 3; ++k) {
    const double i = b[next(k)], j = b[after_next(k)];
    out.col(next(k)) += 3.0 * j * (2.0 * i * near[k] + j * far[k]);
    out.col(after_next(k)) += 3.0 * i * (i * near[k] + 2.0 * j * far[k]);
  }
  return out;
}

Matrix3d PNPatch::dn(const Vector3d& b) const {
  Matrix3d out;
  for (int k = 0; k < 3; ++k) out.col(k) = 2.0 * b[k] * normal[k];
  for (int k = 0; k < 3; ++k) {
    out.col(next(k)) += 2.0 * b[after_next(k)] * bend[k];
    out.col(after_next(k)) += 2.0 * b[next(k)] * bend[k];
  }
  return out;
}

// Newton's method for (p - c) . c' = 0 on the cubic c, with the second derivative bounded from below.
double PNPatch::closest_on_edge(int k, const Vector3d& p) const {
  const Vector3d &from = corner[next(k)], &to = corner[after_next(k)];
  const Vector3d chord = to - from;
  const Vector3d a = near[k] - from, m = far[k] - near[k], e = to - far[k];
  double s = std::clamp((p - from).dot(chord) / chord.squaredNorm(), 0.0, 1.0);
  for (int n = 0; n < iterations_max; ++n) {
    const double r = 1.0 - s;
    const Vector3d c = r * r * r * from + 3.0 * r * s * (r * near[k] + s * far[k]) + s * s * s * to;
    const Vector3d d = 3.0 * (r * r * a + 2.0 * r * s * m + s * s * e), dd = 6.0 * (r * (m - a) + s * (e - m));
    const double bend = std::max(d.squaredNorm() - (p - c).dot(dd), 0.1 * d.squaredNorm());
    const double moved = std::clamp(s + (p - c).dot(d) / bend, 0.0, 1.0);
    if (std::abs(std::exchange(s, moved) - moved) <= converged) break;
  }
  return s;
}

PNRoot::PNRoot(const PNPatch& patch, const Vector3d& p, const SmoothSettings& settings) {
  const Vector3d u = patch.corner[1] - patch.corner[0], v = patch.corner[2] - patch.corner[0], w = u.cross(v);
  const Vector3d from = p - patch.corner[0];
  b[1] = from.cross(v).dot(w) / w.squaredNorm();
  b[2] = u.cross(from).dot(w) / w.squaredNorm();
  b[0] = 1.0 - b[1] - b[2];
  double share = from.dot(w) / w.norm();  // height over |n|, which is nearly 1
  for (int i = 0; i < iterations_max && b.minCoeff() > -settings.beyond_edge; ++i) {
    const Matrix3d slope = patch.dy(b) + share * patch.dn(b);
    normal = patch.n(b);
    Matrix3d jacobian;
    jacobian << slope.col(1) - slope.col(0), slope.col(2) - slope.col(0), normal;
    const double size = jacobian.determinant();
    // Beyond a centre of curvature the axes turn over.
    if (!(size > settings.fold_over * w.norm())) return;
    const Vector3d change = jacobian.inverse() * (p - patch.y(b) - share * normal);
    b += Vector3d(-change[0] - change[1], change[0], change[1]);
    share += change[2];
    if (change.head<2>().cwiseAbs().maxCoeff() > converged) continue;
    normal = patch.n(b);
    height = share * normal.norm();
    normal.normalize();
    point = patch.y(b);
    found = true;
    return;
  }
}

}  // namespace sim_core
