// A triangle mesh at rest in the plane, and the plate element on it.
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

namespace sim_core {

using Points2 = Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor>;
using Triangles = Eigen::Matrix<std::int32_t, Eigen::Dynamic, 3, Eigen::RowMajor>;
using Edges = Eigen::Matrix<std::int32_t, Eigen::Dynamic, 2, Eigen::RowMajor>;
using Rigidity = Eigen::Matrix3d;  // of (H11, H22, 2 H12), N m

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

  // Throws std::invalid_argument, naming the field, unless this is a triangulation of a surface with positive areas.
  ClothMesh(Points2 rest, Triangles triangles);
};

// Second derivatives of a triangle, (H11, H22, 2 H12), from the positions of `nodes`. Nodes from mesh.rest.rows() on
// are the outward slopes that are prescribed at clamped edges, in their order.
struct Stencil {
  std::vector<int> nodes;
  Eigen::Matrix<double, Eigen::Dynamic, 3> weights;  // 1/m^2; 1/m for a slope
};

// Rotation-free Morley element: H = sum over edges e of phi_e |e|/A n_e n_e^T, phi_e = d_e - n_e . grad x_T, with the
// slope d_e across the middle of the edge taken from a quadratic fitted to the nodes around [Morley 1968; the fit after
// Grinspun et al. 2006]. At a free edge phi_e minimises the energy; at a clamped one d_e is given.
// `compact`: the slope is that of the two triangles alone, an approximation that couples fewer nodes.
std::vector<Stencil> bending_stencils(const ClothMesh& mesh, const Rigidity& rigidity, const Edges& clamped,
                                      bool compact = false);

}  // namespace sim_core
