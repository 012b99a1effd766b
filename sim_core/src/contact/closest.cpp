#include "contact/closest.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

namespace sim_core {
namespace {

using Eigen::Vector3d;
using Eigen::Vector4d;

// Squared sine below which segments count as parallel: the determinant a e - b b then has lost all
// but 2 of 16 digits.
constexpr double parallel = 1e-14;
// Bounds the work where pieces slide past each other much slower than the bound of their speed.
constexpr int advances_max = 1000;
// Share of a distance that one advance leaves: s of the algorithm.
constexpr double step_rest = 0.1;

Eigen::Vector2d closest_on_segments(const FourPoints& x) {
  const Vector3d u = x[1] - x[0], v = x[3] - x[2], r = x[0] - x[2];
  const double a = u.squaredNorm(), e = v.squaredNorm(), b = u.dot(v), c = u.dot(r), f = v.dot(r);
  const double denominator = a * e - b * b;
  double s =
      denominator > parallel * a * e ? std::clamp((b * f - c * e) / denominator, 0.0, 1.0) : 0.0;
  double t = e > 0.0 ? (b * s + f) / e : 0.0;
  if (t < 0.0 || t > 1.0) {
    t = std::clamp(t, 0.0, 1.0);
    s = a > 0.0 ? std::clamp((b * t - c) / a, 0.0, 1.0) : 0.0;
  }
  return {s, t};
}

// Triangles in a leaf. Results are the same for any number.
constexpr int leaf_max = 4;

}  // namespace

Vector3d closest_on_triangle(const Vector3d& p, const Vector3d& a, const Vector3d& b,
                             const Vector3d& c) {
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

double MinDistanceRule::of(double distance) const {
  return std::max(fraction * std::min(distance, most), std::min(distance, floor));
}

double safe_fraction(PairKind kind, const FourPoints& x, const FourPoints& to,
                     const MinDistanceRule& rule_of) {
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
  const double least = rule_of.of(distance);
  if (fastest <= distance - least) return 1.0;
  if (!(distance > 0.0) || !std::isfinite(fastest)) return 0.0;
  double fraction = 0.0;
  for (int k = 0; k < advances_max; ++k) {
    // The distance is at least `least` up to here, and above 0 up to `next`.
    const double safe = fraction + (distance - least) / fastest;
    if (safe >= 1.0) return 1.0;
    const double next = std::min(
        1.0, fraction + std::max((1.0 - step_rest) * distance, distance - least) / fastest);
    for (int i = 0; i < 4; ++i) at[i] = x[i] + next * motion[i];
    const double before =
        std::exchange(distance, between_closest(closest_weights(kind, at), at).norm());
    if (distance < least) return fraction + (before - least) / fastest;
    if (next == 1.0) return 1.0;
    fraction = next;
  }
  return fraction;
}

TriangleTree::TriangleTree(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x)
    : triangles_(std::move(triangles)), order_(triangles_.size()), corners_(triangles_.size()) {
  std::iota(order_.begin(), order_.end(), 0);
  std::vector<Vector3d> middles;
  for (const auto& c : triangles_)
    middles.push_back((at_node(x, c[0]) + at_node(x, c[1]) + at_node(x, c[2])) / 3.0);
  if (!triangles_.empty()) build(0, static_cast<int>(triangles_.size()), middles);
  fit(x);
}

int TriangleTree::build(int begin, int end, const std::vector<Vector3d>& middles) {
  const int node = static_cast<int>(boxes_.size());
  boxes_.push_back({{}, begin, end, 0});
  if (end - begin <= leaf_max) return node;
  Eigen::AlignedBox3d around;
  for (int i = begin; i < end; ++i) around.extend(middles[order_[i]]);
  int axis = 0;
  around.diagonal().maxCoeff(&axis);
  const int middle = (begin + end) / 2;
  std::nth_element(
      order_.begin() + begin, order_.begin() + middle, order_.begin() + end, [&](int a, int b) {
        return middles[a][axis] != middles[b][axis] ? middles[a][axis] < middles[b][axis] : a < b;
      });
  build(begin, middle, middles);
  boxes_[node].right = build(middle, end, middles);
  return node;
}

void TriangleTree::fit(const Buffer<double>& x) {
  for (std::size_t t = 0; t < triangles_.size(); ++t) {
    for (int k = 0; k < 3; ++k) corners_[t][k] = at_node(x, triangles_[t][k]);
  }
  for (std::size_t b = boxes_.size(); b-- > 0;) {
    Box& box = boxes_[b];
    if (box.right != 0) {
      box.around = boxes_[b + 1].around.merged(boxes_[box.right].around);
      continue;
    }
    box.around.setEmpty();
    for (int i = box.begin; i < box.end; ++i) {
      for (const Vector3d& corner : corners_[order_[i]]) box.around.extend(corner);
    }
  }
}

Nearest TriangleTree::nearest(const Vector3d& p, double reach,
                              const std::function<bool(int)>& counts) const {
  Nearest out;
  double best = reach * reach;
  const auto away = [&](int b) {
    const Eigen::AlignedBox3d& box = boxes_[b].around;
    return (box.min() - p).cwiseMax(p - box.max()).cwiseMax(0.0).squaredNorm();
  };
  std::vector<std::pair<int, double>> open;
  if (!boxes_.empty()) open.push_back({0, away(0)});
  while (!open.empty()) {
    const auto [b, far] = open.back();
    open.pop_back();
    if (far > best) continue;
    const Box& box = boxes_[b];
    if (box.right != 0) {
      const double left = away(b + 1), right = away(box.right);
      open.push_back(left < right ? std::pair(box.right, right) : std::pair(b + 1, left));
      open.push_back(left < right ? std::pair(b + 1, left) : std::pair(box.right, right));
      continue;
    }
    for (int i = box.begin; i < box.end; ++i) {
      const int t = order_[i];
      if (!counts(t)) continue;
      const auto& [a, c, d] = corners_[t];
      const Vector3d weights = closest_on_triangle(p, a, c, d);
      const double squared = (p - weights[0] * a - weights[1] * c - weights[2] * d).squaredNorm();
      if (squared < best || (squared == best && (out.triangle < 0 || t < out.triangle))) {
        best = squared;
        out = {t, weights};
      }
    }
  }
  return out;
}

}  // namespace sim_core
