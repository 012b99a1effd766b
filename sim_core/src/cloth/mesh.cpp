#include "cloth/mesh.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <numeric>
#include <unordered_map>
#include <utility>
#include <vector>

#include "cloth/refusal.hpp"

namespace sim_core {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

// Whether the open segment pq crosses the triangle abc [Möller & Trumbore 1997].
bool crosses(const Vector3d& p, const Vector3d& q, const Vector3d& a, const Vector3d& b, const Vector3d& c) {
  const Vector3d along = q - p, u = b - a, v = c - a, normal = along.cross(v);
  const double det = u.dot(normal);
  if (std::abs(det) < 1e-14 * along.norm() * u.norm() * v.norm()) return false;
  const Vector3d from = p - a;
  const double s = from.dot(normal) / det;
  if (s < 0.0 || s > 1.0) return false;
  const Vector3d other = from.cross(u);
  const double t = along.dot(other) / det;
  if (t < 0.0 || s + t > 1.0) return false;
  const double at = v.dot(other) / det;
  return at > 0.0 && at < 1.0;
}

}  // namespace

ClothMesh::ClothMesh(Points2 rest_in, Triangles triangles_in)
    : rest(std::move(rest_in)), triangles(std::move(triangles_in)), area(triangles.rows()) {
  if (rest.rows() < 3) refuse(text("rest: must hold at least 3 vertices, got ", rest.rows()));
  if (triangles.rows() < 1) refuse("triangles: must not be empty");
  for (Eigen::Index v = 0; v < rest.rows(); ++v) {
    if (!rest.row(v).allFinite()) refuse(text("rest: must be finite, and vertex ", v, " is not"));
  }
  triangle_edges.resize(triangles.rows());
  std::map<std::pair<int, int>, int> known;
  std::vector<char> used(rest.rows(), 0);
  for (Eigen::Index t = 0; t < triangles.rows(); ++t) {
    for (int c = 0; c < 3; ++c) {
      const int v = triangles(t, c);
      if (v < 0 || v >= rest.rows()) {
        refuse(text("triangles: must index ", rest.rows(), " vertices, got ", v, " in triangle ", t));
      }
      used[v] = 1;
    }
    const Vector2d p = rest.row(triangles(t, 0)), u = rest.row(triangles(t, 1)).transpose() - p,
                   v = rest.row(triangles(t, 2)).transpose() - p;
    area[t] = 0.5 * (u.x() * v.y() - u.y() * v.x());
    const double longest = std::max({u.squaredNorm(), v.squaredNorm(), (u - v).squaredNorm()});
    if (!(area[t] > 1e-3 * longest)) {
      refuse(
          text("triangles: must run counter-clockwise and not be slivers (area over longest edge squared > 0.001), "
               "and triangle ",
               t, " has ", area[t] / longest));
    }
    for (int c = 0; c < 3; ++c) {
      const int i = triangles(t, (c + 1) % 3), j = triangles(t, (c + 2) % 3);
      const auto [at, fresh] = known.try_emplace({std::min(i, j), std::max(i, j)}, static_cast<int>(edges.size()));
      if (fresh) edges.push_back({std::min(i, j), std::max(i, j)});
      Edge& edge = edges[at->second];
      const int side = edge.triangle[0] < 0 ? 0 : 1;
      if (edge.triangle[side] >= 0) refuse(text("triangles: edge (", i, ", ", j, ") must belong to at most two"));
      edge.triangle[side] = static_cast<int>(t);
      edge.corner[side] = c;
      triangle_edges[t][c] = at->second;
    }
  }
  for (Eigen::Index v = 0; v < rest.rows(); ++v) {
    if (!used[v]) refuse(text("rest: every vertex must belong to a triangle, and ", v, " does not"));
  }
  find_sheets();
}

void ClothMesh::find_sheets() {
  std::vector<int> root(rest.rows());
  std::iota(root.begin(), root.end(), 0);
  const auto find = [&](int i) {
    while (root[i] != i) i = root[i] = root[root[i]];
    return i;
  };
  for (const Edge& edge : edges) {
    const int a = find(edge.a), b = find(edge.b);
    root[std::max(a, b)] = std::min(a, b);
  }
  for (int i = 0; i < static_cast<int>(root.size()); ++i) {
    sheet_of_vertex.push_back(find(i) == i ? sheets++ : sheet_of_vertex[find(i)]);
  }
}

int self_intersections(const Points3& positions, const Triangles& triangles) {
  const int count = static_cast<int>(triangles.rows());
  std::vector<Eigen::AlignedBox3d> box(count);
  double size = 0.0;
  for (int t = 0; t < count; ++t) {
    for (int c = 0; c < 3; ++c) box[t].extend(positions.row(triangles(t, c)).transpose());
    size += box[t].sizes().maxCoeff() / count;
  }
  if (!(size > 0.0) || !std::isfinite(size)) return 0;
  // A hash of cells about as large as a triangle.
  const auto key = [](std::int64_t x, std::int64_t y, std::int64_t z) {
    return x * 73856093 ^ y * 19349663 ^ z * 83492791;
  };
  std::unordered_map<std::int64_t, std::vector<int>> cells;
  int found = 0;
  std::vector<int> seen(count, -1);
  for (int t = 0; t < count; ++t) {
    const Eigen::Array3d from = (box[t].min() / size).array().floor(), to = (box[t].max() / size).array().floor();
    for (double x = from[0]; x <= to[0]; ++x) {
      for (double y = from[1]; y <= to[1]; ++y) {
        for (double z = from[2]; z <= to[2]; ++z) {
          std::vector<int>& cell = cells[key(std::int64_t(x), std::int64_t(y), std::int64_t(z))];
          for (int other : cell) {
            if (seen[other] == t) continue;
            seen[other] = t;
            if (!box[t].intersects(box[other])) continue;
            bool common = false;
            for (int i = 0; i < 3; ++i) {
              for (int j = 0; j < 3; ++j) common = common || triangles(t, i) == triangles(other, j);
            }
            if (common) continue;
            Vector3d p[3], q[3];
            for (int c = 0; c < 3; ++c) {
              p[c] = positions.row(triangles(t, c)).transpose();
              q[c] = positions.row(triangles(other, c)).transpose();
            }
            bool hit = false;
            for (int c = 0; c < 3 && !hit; ++c) {
              hit = crosses(p[c], p[(c + 1) % 3], q[0], q[1], q[2]) || crosses(q[c], q[(c + 1) % 3], p[0], p[1], p[2]);
            }
            found += hit;
          }
          cell.push_back(t);
        }
      }
    }
  }
  return found;
}

}  // namespace sim_core
