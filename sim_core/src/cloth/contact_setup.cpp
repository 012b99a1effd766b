#include <algorithm>
#include <array>
#include <cmath>
#include <numeric>
#include <utility>

#include "cloth/solver.hpp"
#include "math/refusal.hpp"

namespace sim_core {
namespace {

using Triples = std::vector<std::array<int, 3>>;

void append(const Triangles& triangles, const int* node, Triples& out) {
  for (Eigen::Index t = 0; t < triangles.rows(); ++t) {
    out.push_back({node[triangles(t, 0)], node[triangles(t, 1)], node[triangles(t, 2)]});
  }
}

void check_thickness(const ClothMesh& mesh, const ContactMaterials& materials) {
  Buffer<double> rest(4L * mesh.rest.rows(), 0.0);
  for (Eigen::Index i = 0; i < mesh.rest.rows(); ++i)
    at_node(rest, i).head<2>() = mesh.rest.row(i).transpose();
  std::vector<int> vertices(mesh.rest.rows());
  std::iota(vertices.begin(), vertices.end(), 0);
  Triples triangles;
  append(mesh.triangles, vertices.data(), triangles);
  const Eigen::Index count = materials.mu.rows();
  CollisionMask collides = CollisionMask::Constant(
      count, count, false);  // sheets lie somewhere at rest, not on each other
  for (Eigen::Index s = 0; s < count; ++s) collides(s, s) = materials.mu(s, s) >= 0.0;
  const double reach = *std::max_element(materials.thickness.begin(), materials.thickness.end());
  for (const Candidate& pair :
       candidates(Surface(triangles, mesh.sheet_of_vertex, collides), rest, reach)) {
    const FourPoints at = points_of(pair, rest);
    const double thickness = materials.thickness[mesh.sheet_of_vertex[pair.node[0]]];
    if (between_closest(closest_weights(pair.kind, at), at).norm() > thickness) continue;
    refuse(
        text("thickness: must be less than the distance at rest of vertices and edges that do not "
             "meet, and vertex ",
             pair.node[0], " is nearer to one than ", thickness, " m"));
  }
}

// Radius of the smallest circle around a triangle at rest, m: its circumcircle, or that of its
// longest side.
double circle_around(const ClothMesh& mesh, Eigen::Index triangle) {
  std::array<double, 3> side;
  for (int c = 0; c < 3; ++c) {
    side[c] = (mesh.rest.row(mesh.triangles(triangle, c)) -
               mesh.rest.row(mesh.triangles(triangle, (c + 1) % 3)))
                  .norm();
  }
  std::sort(side.begin(), side.end());
  const auto [a, b, c] = side;
  return c * c >= a * a + b * b ? 0.5 * c : a * b * c / (4.0 * mesh.area[triangle]);
}

// Sheets, and after them surfaces.
std::vector<int> sheets_of_nodes(const ClothMesh& mesh, const Numbering& numbering,
                                 const SurfaceMeshes& surfaces) {
  std::vector<int> out(numbering.nodes, -1);
  for (int i = 0; i < numbering.vertices; ++i) out[numbering.node[i]] = mesh.sheet_of_vertex[i];
  const int* surface_nodes = numbering.node.data() + numbering.vertices;
  for (int i = 0; i < numbering.surface_vertices; ++i)
    out[surface_nodes[i]] = mesh.sheets + surfaces.surface_of_vertex[i];
  return out;
}

}  // namespace

double cell_of(const ClothMesh& mesh) {
  std::vector<double> area(mesh.sheets, 0.0), triangles(mesh.sheets, 0.0);
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    const int sheet = mesh.sheet_of_vertex[mesh.triangles(t, 0)];
    area[sheet] += mesh.area[t];
    triangles[sheet] += 1.0;
  }
  double out = 0.0;
  for (int s = 0; s < mesh.sheets; ++s)
    out = std::max(out, std::sqrt(2.0 * area[s] / triangles[s]));
  return out;
}

std::vector<double> cells_of_vertices(const ClothMesh& mesh) {
  const Eigen::Index vertices = mesh.rest.rows();
  std::vector<double> out(vertices, 0.0), triangles(vertices, 0.0);
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    for (int c = 0; c < 3; ++c) {
      out[mesh.triangles(t, c)] += mesh.area[t];
      triangles[mesh.triangles(t, c)] += 1.0;
    }
  }
  for (Eigen::Index i = 0; i < vertices; ++i) out[i] = std::sqrt(2.0 * out[i] / triangles[i]);
  return out;
}

std::vector<double> areas_of_vertices(const ClothMesh& mesh) {
  std::vector<double> out(mesh.rest.rows(), 0.0);
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    for (int c = 0; c < 3; ++c) out[mesh.triangles(t, c)] += mesh.area[t] / 3.0;
  }
  return out;
}

std::unique_ptr<ContactSet> contact_set_of(const ClothMesh& mesh, const Numbering& numbering,
                                           const ContactMaterials& materials,
                                           const SurfaceMeshes& surfaces) {
  check_thickness(mesh, materials);
  Triples triangles;
  append(mesh.triangles, numbering.node.data(), triangles);
  append(surfaces.triangles, numbering.node.data() + numbering.vertices, triangles);
  Surface surface(std::move(triangles), sheets_of_nodes(mesh, numbering, surfaces),
                  (materials.mu.array() >= 0.0).matrix());
  const double cell = std::sqrt(2.0 * mesh.area.mean());
  return std::make_unique<ContactSet>(std::move(surface), materials, path::skin * cell,
                                      numbering.free_nodes);
}

std::unique_ptr<SmoothContact> smooth_contact_of(const ClothMesh& mesh, const Numbering& numbering,
                                                 const ContactMaterials& materials,
                                                 const SurfaceMeshes& surfaces) {
  Buffer<double> x(4L * numbering.nodes, 0.0);
  const int* surface_nodes = numbering.node.data() + numbering.vertices;
  for (int i = 0; i < numbering.surface_vertices; ++i)
    at_node(x, surface_nodes[i]) = surfaces.positions.row(i).transpose();
  Triples triangles;
  append(surfaces.triangles, surface_nodes, triangles);
  std::vector<double> radius(numbering.free_nodes, 0.0);
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    const double circumradius = circle_around(mesh, t);
    for (int c = 0; c < 3; ++c) {
      const int node = numbering.node[mesh.triangles(t, c)];
      if (node < numbering.free_nodes) radius[node] = std::max(radius[node], circumradius);
    }
  }
  return std::make_unique<SmoothContact>(std::move(triangles),
                                         sheets_of_nodes(mesh, numbering, surfaces), materials,
                                         surfaces.crease, x, radius);
}

}  // namespace sim_core
