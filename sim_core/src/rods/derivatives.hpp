// Energy, gradient and Hessian of one chain as dense arrays: what the tests compare with finite differences.
#pragma once

#include <Eigen/Core>

namespace sim_core {

struct RodDerivatives {
  double energy;             // EI/L
  Eigen::VectorXd gradient;  // (3 N), by world rotations of nodes 1 ... N
  Eigen::MatrixXd hessian;   // (3 N, 3 N)
};

// quaternions: (N + 1, 4), rows (w, x, y, z), unit; the clamp first.
RodDerivatives rod_derivatives(double gamma, double phi0, double phi1, double twist_stiffness,
                               const Eigen::Ref<const Eigen::Matrix<double, -1, 4, Eigen::RowMajor>>& quaternions);

}  // namespace sim_core
