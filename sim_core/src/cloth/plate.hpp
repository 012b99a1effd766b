// The plate element: second derivatives of each triangle from the positions of the nodes around.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "cloth/properties.hpp"

namespace sim_core {

// Second derivatives of a triangle, (H11, H22, 2 H12), from the positions of `nodes`.
struct Stencil {
  std::vector<int> nodes;
  Eigen::Matrix<double, Eigen::Dynamic, 3> weights;  // 1/m^2
};

// Rotation-free Morley element: H = sum over edges e of phi_e |e|/A n_e n_e^T, phi_e = d_e - n_e . grad x_T, with the
// slope d_e across the middle of the edge taken from a quadratic fitted to the nodes around [Morley 1968; the fit after
// Grinspun et al. 2006]. At the boundary phi_e minimises the energy.
// `compact`: the slope is that of the two triangles alone, an approximation that couples fewer nodes.
std::vector<Stencil> bending_stencils(const ClothMesh& mesh, const Fabrics& fabrics, bool compact = false);

}  // namespace sim_core
