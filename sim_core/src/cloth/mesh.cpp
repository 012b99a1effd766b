#include "cloth/mesh.hpp"

#include <algorithm>
#include <map>
#include <numeric>
#include <utility>

#include "cloth/refusal.hpp"

namespace sim_core {

using Eigen::Vector2d;

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

}  // namespace sim_core
