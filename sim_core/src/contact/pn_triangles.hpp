// A smooth surface through the vertices of triangles, and the point of it that lies below a point.
//
// Each triangle carries a cubic patch y(b) and a field of normals N(b), both of its corners P_i and
// the normals N_i there, with barycentric coordinates b. The patch is that of a curved PN triangle
// [Vlachos et al. 2001, Eqs. 1-4]:
//
//     y = sum P_i b_i^3 + 3 sum_{i != j} E_ij b_i^2 b_j + 6 C b_0 b_1 b_2
//     E_ij = P_i + (c - (c . N_i) N_i)/3,  c = P_j - P_i,    C = E + (E - V)/2
//
// with E the mean of the six E_ij, V that of the corners. The normals are unit ones at the corners
// and in the middle of the edges, where they stand on the patch, m ~ (1 - T T^T)(N_i + N_j), T the
// tangent of the edge there:
//
//     N = sum N_i b_i^2 + sum_{i != j} Q_ij b_i b_j,    Q_ij = Q_ji = 2 m - (N_i + N_j)/2
//
// Along an edge both depend on that edge alone: so patch and normals are continuous, and so is the
// projection (b, height) of a point p, the root of y(b) + height N/|N| = p [after the Phong
// projection of Panozzo et al. 2013], as long as p is nearer than the centres of curvature. The
// patch misses a sphere by the fourth power of the edges' length over its radius, and N misses the
// direction in which the height grows by their second, times the change of curvature.
//
// Edges stay sharp where they are borders, where the triangles on both sides meet at more than an
// angle that is given, where there are more than two, or where both sides cannot be oriented alike.
// There the normals of the two sides are different ones, the edge's tangents are their vector
// products, and points between them have their projection on the edge or at its end.
#pragma once

#include <Eigen/Core>
#include <array>
#include <map>
#include <optional>
#include <vector>

#include "math/buffer.hpp"

namespace sim_core {

// Triangles of a smooth surface: their orientation, neighbours, and which edges are sharp.
struct CreasedTriangles {
  std::vector<std::array<int, 3>> triangles;  // nodes, oriented alike where they can be
  std::vector<std::array<int, 3>>
      across;  // triangle over the edge opposite each corner; -1 at a border
  std::vector<std::array<int, 3>> sharp;  // 1 where that edge is sharp
  std::vector<std::array<int, 3>> group;  // of the corners; corners of one group share a normal
  std::vector<int> around_begin, around;  // triangles around each node
  int groups = 0;

  // `crease`: angle between the normals of two triangles from which their edge is sharp, rad, of
  // each triangle.
  CreasedTriangles(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x,
                   const std::vector<double>& crease);

  Eigen::Vector3d facet_normal(const Buffer<double>& x, int triangle) const;
  // Corner of a triangle at a node.
  int corner_of(int triangle, int node) const;

 private:
  using Sides = std::map<std::array<int, 2>, std::vector<int>>;  // triangles at each edge
  int other(const Sides& sides, int triangle, int corner) const;
  bool runs(int triangle, int i, int j) const;
  void orient(const Sides& sides);
  void find_sharp(const Sides& sides, const Buffer<double>& x, const std::vector<double>& crease);
};

// Corners of a triangle after one of them.
inline int next(int corner) { return (corner + 1) % 3; }
inline int after_next(int corner) { return (corner + 2) % 3; }

// One curved triangle: y(b) and N(b).
struct PNPatch {
  std::array<Eigen::Vector3d, 3> corner, normal;
  std::array<Eigen::Vector3d, 3> near,
      far;  // handles E_ij and E_ji of the edge opposite each corner, i the next corner
  std::array<Eigen::Vector3d, 3> bend;  // Q_ij of that edge
  Eigen::Vector3d middle;               // C

  Eigen::Vector3d y(const Eigen::Vector3d& b) const;
  Eigen::Vector3d n(const Eigen::Vector3d& b) const;
  // Derivatives by each coordinate of b.
  Eigen::Matrix3d dy(const Eigen::Vector3d& b) const;
  Eigen::Matrix3d dn(const Eigen::Vector3d& b) const;

  // Place s in [0, 1] on the curved edge opposite corner k, from the next corner on, that is
  // closest to p.
  double closest_on_edge(int k, const Eigen::Vector3d& p) const;
};

// Root of y(b) + height n(b)/|n| = p, in the triangle or its continuation beyond the edges.
struct PNRoot {
  Eigen::Vector3d b, normal, point;
  double height = 0.0;  // m
  bool is_solved = false;

  PNRoot(const PNPatch& patch, const Eigen::Vector3d& p);
};

// Where a surface is: its nodes, and of the corners of its triangles the normals and the largest
// curvature of an edge there, seen from the side where the normals point to and from the other, 0
// where it is hollow.
struct PatchShape {
  Buffer<double> x;
  std::vector<Eigen::Vector3d> normals;               // by group of corners
  std::vector<std::array<double, 2>> curvature = {};  // 1/m
  double bulge = 0.0;  // m: how far patches are from their triangles at most
};

struct Projection {
  int triangle;
  Eigen::Vector3d weights;  // barycentric
  Eigen::Vector3d point;    // y, m
  Eigen::Vector3d normal;   // towards the side that is asked for
  double height;            // m: over y, negative on the other side
  bool on_patch;            // or on a sharp edge, or at an end of one
};

class PNTriangles {
 public:
  // `crease`: see CreasedTriangles.
  PNTriangles(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x,
              const std::vector<double>& crease);

  const std::vector<std::array<int, 3>>& triangles() const { return mesh_.triangles; }
  PatchShape shape(const Buffer<double>& x) const;

  // The foot of p on a side (1: where the triangles' normals point to, after orientation; or -1),
  // looked for from a triangle on. None where p is too far off.
  std::optional<Projection> projection(const PatchShape& shape, const Eigen::Vector3d& p,
                                       int triangle, double side) const;

  // On which side p is of the triangles themselves, of which its closest point is this one of this
  // triangle [Baerentzen & Aanaes 2005].
  double side_of(const PatchShape& shape, const Eigen::Vector3d& p, int triangle,
                 const Eigen::Vector3d& weights) const;

  // How much the surface bulges there towards a side, between its corners, 1/m.
  double curvature(const PatchShape& shape, int triangle, const Eigen::Vector3d& weights,
                   double side) const;

  // The point of the surface, and axes that turn with it there, of which the last is N.
  Eigen::Vector3d point(const PatchShape& shape, int triangle,
                        const Eigen::Vector3d& weights) const;
  Eigen::Matrix3d axes(const PatchShape& shape, int triangle, const Eigen::Vector3d& weights) const;

 private:
  PNPatch patch(const PatchShape& shape, int triangle) const;
  Eigen::Vector3d edge_handle(const PatchShape& shape, int triangle, int from, int to) const;
  std::optional<Projection> foot_around(const PatchShape& shape, const Eigen::Vector3d& p,
                                        int triangle, double side) const;

  CreasedTriangles mesh_;
};

}  // namespace sim_core
