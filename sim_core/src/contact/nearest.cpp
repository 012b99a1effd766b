#include "contact/nearest.hpp"

#include <algorithm>
#include <numeric>
#include <utility>

#include "contact/closest.hpp"

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Triangles in a leaf. Results are the same for any number.
constexpr int leaf_max = 4;

}  // namespace

TriangleTree::TriangleTree(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x)
    : triangles_(std::move(triangles)), order_(triangles_.size()), corners_(triangles_.size()) {
  std::iota(order_.begin(), order_.end(), 0);
  std::vector<Vector3d> middles;
  for (const auto& c : triangles_) middles.push_back((at_node(x, c[0]) + at_node(x, c[1]) + at_node(x, c[2])) / 3.0);
  if (!triangles_.empty()) build(0, static_cast<int>(triangles_.size()), middles);
  fit(x);
}

int TriangleTree::build(int begin, int end, const std::vector<Vector3d>& middles) {
  const int own = static_cast<int>(boxes_.size());
  boxes_.push_back({{}, begin, end, 0});
  if (end - begin <= leaf_max) return own;
  Eigen::AlignedBox3d around;
  for (int i = begin; i < end; ++i) around.extend(middles[order_[i]]);
  int axis = 0;
  around.diagonal().maxCoeff(&axis);
  const int middle = (begin + end) / 2;
  std::nth_element(order_.begin() + begin, order_.begin() + middle, order_.begin() + end, [&](int a, int b) {
    return middles[a][axis] != middles[b][axis] ? middles[a][axis] < middles[b][axis] : a < b;
  });
  build(begin, middle, middles);
  boxes_[own].right = build(middle, end, middles);
  return own;
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

Nearest TriangleTree::nearest(const Vector3d& p, double reach, const std::function<bool(int)>& counts) const {
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
