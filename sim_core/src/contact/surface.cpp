#include "contact/surface.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <utility>

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

Matrix3d axes(const std::array<int, 3>& corner, const Buffer<double>& x) {
  const Vector3d a = at_node(x, corner[1]) - at_node(x, corner[0]),
                 b = at_node(x, corner[2]) - at_node(x, corner[0]);
  Matrix3d out;
  out.col(0) = a.normalized();
  out.col(2) = a.cross(b).normalized();
  out.col(1) = out.col(2).cross(out.col(0));
  return out;
}

}  // namespace

Surface::Surface(std::vector<std::array<int, 3>> triangles_in, std::vector<int> sheet_of_node_in,
                 CollisionMask collides_in)
    : triangles(std::move(triangles_in)),
      around_begin(sheet_of_node_in.size() + 1, 0),
      sheet_of_node(std::move(sheet_of_node_in)),
      collides(std::move(collides_in)),
      last_collider(collides.rows(), -1) {
  for (std::size_t i = 0; i < sheet_of_node.size(); ++i) {
    if (sheet_of_node[i] < 0) continue;
    for (Eigen::Index sheet = 0; sheet < collides.rows(); ++sheet) {
      if (collides(sheet, sheet_of_node[i])) last_collider[sheet] = static_cast<int>(i);
    }
  }
  for (const auto& corners : triangles) {
    for (int c = 0; c < 3; ++c) {
      const int i = corners[(c + 1) % 3], j = corners[(c + 2) % 3];
      edges.push_back({std::min(i, j), std::max(i, j)});
      ++around_begin[corners[c] + 1];
    }
  }
  std::sort(edges.begin(), edges.end());
  edges.erase(std::unique(edges.begin(), edges.end()), edges.end());
  triangles_of_edge.assign(edges.size(), 0);
  for (const auto& corners : triangles) {
    std::array<int, 3> edges_of_triangle;
    for (int c = 0; c < 3; ++c) {
      const int i = corners[(c + 1) % 3], j = corners[(c + 2) % 3];
      const std::array<int, 2> edge{std::min(i, j), std::max(i, j)};
      edges_of_triangle[c] =
          static_cast<int>(std::lower_bound(edges.begin(), edges.end(), edge) - edges.begin());
      ++triangles_of_edge[edges_of_triangle[c]];
    }
    triangle_edges.push_back(edges_of_triangle);
  }
  for (std::size_t i = 0; i < sheet_of_node.size(); ++i) {
    if (around_begin[i + 1] > 0) vertices.push_back(static_cast<int>(i));
    around_begin[i + 1] += around_begin[i];
  }
  around.resize(around_begin.back());
  std::vector<int> next(around_begin.begin(), around_begin.end() - 1);
  for (std::size_t t = 0; t < triangles.size(); ++t) {
    for (int corner : triangles[t]) around[next[corner]++] = static_cast<int>(t);
  }
}

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
    here.turn = Matrix3d::Identity() + std::clamp(2.0 - angle / pairs::turn_max, 0.0, 1.0) *
                                           (here.turn - Matrix3d::Identity());
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
