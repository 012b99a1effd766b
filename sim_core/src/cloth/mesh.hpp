// Cloth at rest: its mesh in the plane, what it is made of, and the plate element.
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <map>
#include <utility>
#include <vector>

#include "cloth/problem.hpp"
#include "math/refusal.hpp"

namespace sim_core {

using Points2 = Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor>;
using Points3 = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;
using Triangles = Eigen::Matrix<std::int32_t, Eigen::Dynamic, 3, Eigen::RowMajor>;

struct ClothMesh {
  struct Edge {
    int a, b;  // a < b
    std::array<int, 2> triangle{-1, -1};
    std::array<int, 2> corner{-1, -1};  // the one opposite, 0 ... 2
    bool boundary() const { return triangle[1] < 0; }
  };

  Points2 rest;
  Triangles triangles;
  std::vector<Edge> edges;
  std::vector<std::array<int, 3>> triangle_edges;  // opposite corner 0, 1, 2
  Eigen::VectorXd area;
  std::vector<int>
      sheet_of_vertex;  // pieces that hang together, in the order of their first vertices
  int sheets = 0;

  // Throws std::invalid_argument, naming the field, unless this is a triangulation of a surface
  // with positive areas.
  ClothMesh(Points2 rest, Triangles triangles);

 private:
  using EdgeNumbers = std::map<std::pair<int, int>, int>;  // by the lower and the higher vertex
  void add_edge(EdgeNumbers& numbers, int t, int corner);
  void find_sheets();
};

using Rigidity = Eigen::Matrix3d;  // D of (H11, H22, 2 H12), N m

// Stiffness against stretching after [Wang et al. 2011]: k0 ... k3 [N/m] of the energy k0 G00^2/2 +
// k1 G00 G11 + k2 G11^2/2 + k3 G01^2. Row 0 holds at no strain, rows 1 ... 5 at `table_stretch`
// with the larger principal stretch 0, 22.5, ..., 90 degrees from the first axis;
// kernels/stretching.hpp has the law in between.
using StretchTable = Eigen::Matrix<double, 6, 4, Eigen::RowMajor>;

struct ClothProperties {
  double density;  // kg/m^2
  StretchTable stretching;
  Rigidity rigidity;
  double damping;          // proportional to mass, 1/s
  double softening = 0.0;  // k_s, 1/m: see kernels/bending.hpp; 0: none
};

// The fabrics of a cloth: one for all of its sheets, or one for each.
struct Fabrics {
  std::vector<ClothProperties> list;
  std::vector<int> of_triangle;

  // Throws std::invalid_argument, naming `fabric`, where there are too many or too few.
  Fabrics(const ClothMesh& mesh, std::vector<ClothProperties> list_in) : list(std::move(list_in)) {
    if (list.size() != 1 && static_cast<int>(list.size()) != mesh.sheets) {
      refuse(text("fabric: must be one, or one for each of ", mesh.sheets, " sheets, got ",
                  list.size()));
    }
    for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
      of_triangle.push_back(list.size() == 1 ? 0 : mesh.sheet_of_vertex[mesh.triangles(t, 0)]);
    }
  }
  const ClothProperties& at(Eigen::Index triangle) const { return list[of_triangle[triangle]]; }
};

// Number of pairs of triangles without a common vertex of which an edge of one crosses the other.
int self_intersections(const Points3& positions, const Triangles& triangles);

// Second derivatives of a triangle, (H11, H22, 2 H12), from the positions of `nodes`.
struct Stencil {
  std::vector<int> nodes;
  Eigen::Matrix<double, Eigen::Dynamic, 3> weights;  // 1/m^2
};

// Rotation-free Morley element: H = sum over edges e of phi_e |e|/A n_e n_e^T, phi_e = d_e - n_e .
// grad x_T, with the slope d_e across the middle of the edge taken from a quadratic fitted to the
// nodes around [Morley 1968; the fit after Grinspun et al. 2006]. At the boundary phi_e minimises
// the energy. `compact`: the slope is that of the two triangles alone, an approximation that
// couples fewer nodes.
std::vector<Stencil> bending_stencils(const ClothMesh& mesh, const Fabrics& fabrics,
                                      bool compact = false);

}  // namespace sim_core
