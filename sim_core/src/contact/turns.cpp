#include "contact/turns.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

namespace sim_core {

using Eigen::Matrix3d;
using Eigen::Vector3d;

namespace {

Matrix3d axes(const std::array<int, 3>& corner, const Buffer<double>& x) {
  const Vector3d a = at_node(x, corner[1]) - at_node(x, corner[0]), b = at_node(x, corner[2]) - at_node(x, corner[0]);
  Matrix3d out;
  out.col(0) = a.normalized();
  out.col(2) = a.cross(b).normalized();
  out.col(1) = out.col(2).cross(out.col(0));
  return out;
}

}  // namespace

void Turns::begin(const Buffer<double>& start, const Buffer<double>& expected, int free_nodes) {
  free_nodes_ = free_nodes;
  start_ = start;
  expected_ = expected;
  ++step_;
}

const Matrix3d& Turns::of(const Surface& surface, int node) {
  nodes_.resize(surface.sheet_of_node.size());
  Turn& here = nodes_[node];
  if (here.step == step_) return here.turn;
  here.step = step_;
  here.turn.setZero();
  const int begin = surface.around_begin[node], end = surface.around_begin[node + 1];
  for (int t = begin; t < end; ++t) here.turn += turn_of(surface, surface.around[t]);
  here.turn /= end - begin;
  if (node < free_nodes_) {
    const double angle = std::sqrt(std::max(3.0 - here.turn.trace(), 0.0));
    here.turn =
        Matrix3d::Identity() + std::clamp(2.0 - angle / turn_max_, 0.0, 1.0) * (here.turn - Matrix3d::Identity());
  }
  return here.turn;
}

const Matrix3d& Turns::turn_of(const Surface& surface, int triangle) {
  triangles_.resize(surface.triangles.size());
  Turn& here = triangles_[triangle];
  if (here.step == step_) return here.turn;
  here.step = step_;
  const auto& corner = surface.triangles[triangle];
  here.turn = axes(corner, expected_) * axes(corner, start_).transpose();
  return here.turn;
}

}  // namespace sim_core
