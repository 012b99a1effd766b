// Counts triangles of a mesh in space that cross each other.
#include <Eigen/Dense>
#include <Eigen/Geometry>
#include <cmath>
#include <cstdint>
#include <unordered_map>
#include <vector>

#include "cloth/mesh.hpp"

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Whether the open segment pq crosses the triangle abc [Möller & Trumbore 1997].
bool crosses(const Vector3d& p, const Vector3d& q, const Vector3d& a, const Vector3d& b,
             const Vector3d& c) {
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

// Calls with the key of each cell of side `size` that a box meets; different cells may share one.
template <class Call>
void visit_cells(const Eigen::AlignedBox3d& box, double size, const Call& call) {
  const auto key = [](std::int64_t x, std::int64_t y, std::int64_t z) {
    return x * 73856093 ^ y * 19349663 ^ z * 83492791;
  };
  const Eigen::Array3d from = (box.min() / size).array().floor(),
                       to = (box.max() / size).array().floor();
  for (double x = from[0]; x <= to[0]; ++x) {
    for (double y = from[1]; y <= to[1]; ++y) {
      for (double z = from[2]; z <= to[2]; ++z)
        call(key(std::int64_t(x), std::int64_t(y), std::int64_t(z)));
    }
  }
}

bool have_common_vertex(const Triangles& triangles, int t, int other) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      if (triangles(t, i) == triangles(other, j)) return true;
    }
  }
  return false;
}

// Whether an edge of one triangle crosses the other.
bool triangles_cross(const Points3& positions, const Triangles& triangles, int t, int other) {
  Vector3d p[3], q[3];
  for (int c = 0; c < 3; ++c) {
    p[c] = positions.row(triangles(t, c)).transpose();
    q[c] = positions.row(triangles(other, c)).transpose();
  }
  for (int c = 0; c < 3; ++c) {
    if (crosses(p[c], p[(c + 1) % 3], q[0], q[1], q[2])) return true;
    if (crosses(q[c], q[(c + 1) % 3], p[0], p[1], p[2])) return true;
  }
  return false;
}

}  // namespace

int self_intersections(const Points3& positions, const Triangles& triangles) {
  const int count = static_cast<int>(triangles.rows());
  std::vector<Eigen::AlignedBox3d> box(count);
  double size = 0.0;
  for (int t = 0; t < count; ++t) {
    for (int c = 0; c < 3; ++c) box[t].extend(positions.row(triangles(t, c)).transpose());
    size += box[t].sizes().maxCoeff() / count;
  }
  if (!(size > 0.0) || !std::isfinite(size)) return 0;

  // A hash of cells about as large as a triangle, each with the triangles before t that meet it.
  std::unordered_map<std::int64_t, std::vector<int>> cells;
  int intersections = 0;
  std::vector<int> compared_with(count, -1);
  for (int t = 0; t < count; ++t) {
    visit_cells(box[t], size, [&](std::int64_t key) {
      std::vector<int>& cell = cells[key];
      for (int other : cell) {
        if (compared_with[other] == t) continue;
        compared_with[other] = t;
        const bool may_cross =
            box[t].intersects(box[other]) && !have_common_vertex(triangles, t, other);
        intersections += may_cross && triangles_cross(positions, triangles, t, other);
      }
      cell.push_back(t);
    });
  }
  return intersections;
}

}  // namespace sim_core
