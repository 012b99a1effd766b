// Friction of cloth that turns at its nodes only.
//
// Where the face of a body turns by an angle a along a cell, cloth turns by all of it at a node.
// The balance of a node between two straight sides, whose tensions T1 and T2 meet at a, gives
//
//     T2/T1 = (1 + mu tan(a/2))/(1 - mu tan(a/2))
//
// and a smooth band has the capstan equation, exp(mu a). The coefficient
//
//     mu' = tanh(mu a/2)/tan(a/2)
//
// makes both equal, whatever the cell. To second order it is mu (1 - (1 + mu^2) a^2/12).
#pragma once

#include <Eigen/Core>

namespace sim_core {

// Unit normals of a face: at a node, and half a cell from it along friction, on its tangent.
struct NormalsOfCell {
  Eigen::Vector3d behind, here, ahead;
};

// The coefficient mu' of a node, and its derivative by mu.
struct FrictionCoefficient {
  double mu;
  double by_mu = 1.0;
};

// `along`: unit direction of friction.
FrictionCoefficient mu_between_cells(double mu, const NormalsOfCell& normals,
                                     const Eigen::Vector3d& along);

}  // namespace sim_core
