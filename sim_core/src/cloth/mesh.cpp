#include "cloth/mesh.hpp"

#include <Eigen/Dense>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <numeric>
#include <utility>
#include <vector>

#include "math/refusal.hpp"

namespace sim_core {
namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;
using Eigen::VectorXd;

// A fit is trusted when its singular values, over the largest, stay above this.
constexpr double rank_min = 0.03;

Vector2d normal_of(const Vector2d& along) { return Vector2d(along.y(), -along.x()) / along.norm(); }

struct SlopeFit {
  std::vector<int> nodes;
  VectorXd weights;
};

// d/dn at the middle of an edge, exact for quadratics: least squares over the nodes of the two
// triangles and of their neighbours, ring after ring until they determine a quadratic.
SlopeFit fit_slope(const ClothMesh& mesh, const std::vector<std::vector<int>>& around,
                   const ClothMesh::Edge& edge, const Vector2d& normal) {
  const Vector2d a = mesh.rest.row(edge.a), b = mesh.rest.row(edge.b);
  const Vector2d middle = 0.5 * (a + b), tangent = (b - a).normalized();
  const double scale = (b - a).norm();
  std::vector<int> ring{edge.triangle[0], edge.triangle[1]};
  for (int growth = 0; growth < 4; ++growth) {
    std::vector<int> wider = ring;
    for (int t : ring) wider.insert(wider.end(), around[t].begin(), around[t].end());
    std::sort(wider.begin(), wider.end());
    wider.erase(std::unique(wider.begin(), wider.end()), wider.end());
    ring = wider;
    std::vector<int> nodes;
    for (int t : ring) {
      for (int c = 0; c < 3; ++c) nodes.push_back(mesh.triangles(t, c));
    }
    std::sort(nodes.begin(), nodes.end());
    nodes.erase(std::unique(nodes.begin(), nodes.end()), nodes.end());
    const int count = static_cast<int>(nodes.size());
    if (count < 6) continue;
    Eigen::MatrixXd fit(count, 6);
    VectorXd weight(count);
    for (int i = 0; i < count; ++i) {
      const Vector2d offset = (mesh.rest.row(nodes[i]).transpose() - middle) / scale;
      const double u = tangent.dot(offset), v = normal.dot(offset);
      weight[i] = 1.0 / (0.25 + offset.squaredNorm());
      fit.row(i) << 1.0, u, v, u * u, u * v, v * v;
      fit.row(i) *= weight[i];
    }
    const Eigen::JacobiSVD<Eigen::MatrixXd> svd(fit, Eigen::ComputeThinU | Eigen::ComputeThinV);
    if (svd.singularValues()[5] < rank_min * svd.singularValues()[0]) continue;
    // Row of the pseudo-inverse that gives the coefficient of v.
    const VectorXd row = svd.matrixU() * (svd.singularValues().cwiseInverse().asDiagonal() *
                                          svd.matrixV().row(2).transpose());
    return {nodes, row.cwiseProduct(weight) / scale};
  }
  refuse(text("triangles: the nodes around edge (", edge.a, ", ", edge.b,
              ") must determine a quadratic; refine the mesh"));
}

// d/dn at an edge between the slopes of its two triangles, which hold at their centroids.
SlopeFit mean_slope(const ClothMesh& mesh, const ClothMesh::Edge& edge, const Vector2d& normal) {
  SlopeFit fit{{edge.a, edge.b, -1, -1}, VectorXd::Zero(4)};
  const double areas = mesh.area[edge.triangle[0]] + mesh.area[edge.triangle[1]];
  for (int side = 0; side < 2; ++side) {
    const int t = edge.triangle[side], other = edge.triangle[1 - side];
    const double fraction = mesh.area[other] / areas;  // heights over the edge are as the areas
    fit.nodes[2 + side] = mesh.triangles(t, edge.corner[side]);
    for (int c = 0; c < 3; ++c) {
      const Vector2d along = (mesh.rest.row(mesh.triangles(t, (c + 2) % 3)) -
                              mesh.rest.row(mesh.triangles(t, (c + 1) % 3)))
                                 .transpose();
      const Vector2d gradient = -normal_of(along) * along.norm() / (2.0 * mesh.area[t]);
      const int node = mesh.triangles(t, c);
      const int place = node == edge.a ? 0 : node == edge.b ? 1 : 2 + side;
      fit.weights[place] += fraction * normal.dot(gradient);
    }
  }
  return fit;
}

void check_corners(const Points2& rest, const Triangles& triangles, Eigen::Index t) {
  for (int c = 0; c < 3; ++c) {
    const int v = triangles(t, c);
    if (v >= 0 && v < rest.rows()) continue;
    refuse(text("triangles: must index ", rest.rows(), " vertices, got ", v, " in triangle ", t));
  }
}

// Of a triangle at rest, m^2.
double checked_area(const Points2& rest, const Triangles& triangles, Eigen::Index t) {
  const Vector2d p = rest.row(triangles(t, 0)), u = rest.row(triangles(t, 1)).transpose() - p,
                 v = rest.row(triangles(t, 2)).transpose() - p;
  const double area = 0.5 * (u.x() * v.y() - u.y() * v.x());
  const double longest = std::max({u.squaredNorm(), v.squaredNorm(), (u - v).squaredNorm()});
  if (!(area > 1e-3 * longest)) {
    refuse(
        text("triangles: must run counter-clockwise and not be slivers (area over longest edge "
             "squared > 0.001), "
             "and triangle ",
             t, " has ", area / longest));
  }
  return area;
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
  EdgeNumbers numbers;
  std::vector<char> used(rest.rows(), 0);
  for (Eigen::Index t = 0; t < triangles.rows(); ++t) {
    check_corners(rest, triangles, t);
    for (int c = 0; c < 3; ++c) used[triangles(t, c)] = 1;
    area[t] = checked_area(rest, triangles, t);
    for (int c = 0; c < 3; ++c) add_edge(numbers, static_cast<int>(t), c);
  }
  for (Eigen::Index v = 0; v < rest.rows(); ++v) {
    if (!used[v])
      refuse(text("rest: every vertex must belong to a triangle, and ", v, " does not"));
  }
  find_sheets();
}

// Enters the edge opposite a corner of a triangle.
void ClothMesh::add_edge(EdgeNumbers& numbers, int t, int corner) {
  const int i = triangles(t, (corner + 1) % 3), j = triangles(t, (corner + 2) % 3);
  const auto [at, fresh] =
      numbers.try_emplace({std::min(i, j), std::max(i, j)}, static_cast<int>(edges.size()));
  if (fresh) edges.push_back({std::min(i, j), std::max(i, j)});
  Edge& edge = edges[at->second];
  const int side = edge.triangle[0] < 0 ? 0 : 1;
  if (edge.triangle[side] >= 0)
    refuse(text("triangles: edge (", i, ", ", j, ") must belong to at most two"));
  edge.triangle[side] = t;
  edge.corner[side] = corner;
  triangle_edges[t][corner] = at->second;
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

namespace {

std::vector<std::vector<int>> triangles_beside(const ClothMesh& mesh) {
  std::vector<std::vector<int>> beside(mesh.triangles.rows());
  for (const ClothMesh::Edge& edge : mesh.edges) {
    if (edge.boundary()) continue;
    beside[edge.triangle[0]].push_back(edge.triangle[1]);
    beside[edge.triangle[1]].push_back(edge.triangle[0]);
  }
  return beside;
}

// The slope across each edge inside the mesh.
std::vector<SlopeFit> slopes_of_edges(const ClothMesh& mesh, bool compact) {
  const std::vector<std::vector<int>> beside = triangles_beside(mesh);
  std::vector<SlopeFit> slopes(mesh.edges.size());
  for (std::size_t e = 0; e < mesh.edges.size(); ++e) {
    const ClothMesh::Edge& edge = mesh.edges[e];
    if (edge.boundary()) continue;
    const Vector2d along = (mesh.rest.row(edge.b) - mesh.rest.row(edge.a)).transpose();
    slopes[e] = compact ? mean_slope(mesh, edge, normal_of(along))
                        : fit_slope(mesh, beside, edge, normal_of(along));
  }
  return slopes;
}

// The sides of a triangle at rest, opposite its corners.
struct Sides {
  Vector2d normal[3], gradient[3];  // outward, and of the height over the side, 1/m
  double length[3];                 // m

  Sides(const ClothMesh& mesh, int t) {
    Vector2d p[3];
    for (int c = 0; c < 3; ++c) p[c] = mesh.rest.row(mesh.triangles(t, c));
    for (int c = 0; c < 3; ++c) {
      const Vector2d along = p[(c + 2) % 3] - p[(c + 1) % 3];
      length[c] = along.norm();
      normal[c] = normal_of(along);  // outward: the triangle runs counter-clockwise
      gradient[c] = -normal[c] * length[c] / (2.0 * mesh.area[t]);
    }
  }
};

// What takes curvature across open sides, `open`, out of a triangle's: no moment acts on them.
Eigen::Matrix3d without_moments(const std::vector<Eigen::Vector3d>& open,
                                const Rigidity& rigidity) {
  Eigen::Matrix3d project = Eigen::Matrix3d::Identity();
  if (open.empty()) return project;
  Eigen::MatrixXd n(3, open.size());
  for (std::size_t i = 0; i < open.size(); ++i) n.col(i) = open[i];
  project -= n * (n.transpose() * rigidity * n).ldlt().solve(n.transpose() * rigidity);
  return project;
}

Stencil bending_stencil(const ClothMesh& mesh, const Rigidity& rigidity,
                        const std::vector<SlopeFit>& slopes, int t) {
  std::map<int, Eigen::Vector3d> entries;
  const auto add = [&](int node, const Eigen::Vector3d& weight) {
    const auto [at, fresh] = entries.try_emplace(node, Eigen::Vector3d::Zero());
    at->second += weight;
  };
  const Sides sides(mesh, t);
  std::vector<Eigen::Vector3d> open;
  for (int c = 0; c < 3; ++c) {
    const int e = mesh.triangle_edges[t][c];
    const ClothMesh::Edge& edge = mesh.edges[e];
    const Vector2d& normal = sides.normal[c];
    const Eigen::Vector3d direction =
        sides.length[c] / mesh.area[t] *
        Eigen::Vector3d(normal.x() * normal.x(), normal.y() * normal.y(),
                        2.0 * normal.x() * normal.y());
    if (edge.boundary()) {
      open.push_back(direction);
      continue;
    }
    const Vector2d along = (mesh.rest.row(edge.b) - mesh.rest.row(edge.a)).transpose();
    const double sign = normal_of(along).dot(normal) > 0.0 ? 1.0 : -1.0;
    for (std::size_t i = 0; i < slopes[e].nodes.size(); ++i) {
      add(slopes[e].nodes[i], sign * slopes[e].weights[i] * direction);
    }
    for (int i = 0; i < 3; ++i)
      add(mesh.triangles(t, i), -normal.dot(sides.gradient[i]) * direction);
  }
  const Eigen::Matrix3d project = without_moments(open, rigidity);
  Stencil stencil;
  stencil.weights.resize(entries.size(), 3);
  for (const auto& [node, weight] : entries) {
    stencil.weights.row(stencil.nodes.size()) = (project * weight).transpose();
    stencil.nodes.push_back(node);
  }
  return stencil;
}

}  // namespace

std::vector<Stencil> bending_stencils(const ClothMesh& mesh, const Fabrics& fabrics, bool compact) {
  const std::vector<SlopeFit> slopes = slopes_of_edges(mesh, compact);
  std::vector<Stencil> stencils;
  for (int t = 0; t < static_cast<int>(mesh.triangles.rows()); ++t)
    stencils.push_back(bending_stencil(mesh, fabrics.at(t).rigidity, slopes, t));
  return stencils;
}

}  // namespace sim_core
