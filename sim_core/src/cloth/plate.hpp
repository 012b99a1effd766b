// The plate element: second derivatives of each triangle from the positions of the nodes around.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "cloth/properties.hpp"

namespace sim_core {

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
std::vector<Stencil> bending_stencils(const ClothMesh& mesh, const Fabrics& fabrics, const Edges& clamped,
                                      bool compact = false);

}  // namespace sim_core
