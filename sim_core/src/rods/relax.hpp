// One chain from given frames to the equilibrium next to them, with its certificate: what the protocols follow branches
// of equilibria with. solve_rods starts from the natural shape instead, and extrapolates.
#pragma once

#include <Eigen/Core>

namespace sim_core {

using Quaternions = Eigen::Matrix<double, -1, 4, Eigen::RowMajor>;

struct RelaxedRod {
  Quaternions quaternions;  // (N + 1, 4): rows (w, x, y, z)
  double energy;            // EI/L
  double residual;          // EI/L: largest out-of-balance nodal moment before the last step
  int iterations;           // evaluations of the Hessian
  bool converged;
  bool stable;  // converged, and the Hessian at these frames is positive definite
};

// quaternions: (N + 1, 4), rows (w, x, y, z), unit, neighbours less than half a turn apart; the first one, the clamp,
// stays. Throws std::invalid_argument for fewer than two rows.
RelaxedRod relax_rod(double gamma, double phi0, double phi1, double twist_stiffness,
                     const Eigen::Ref<const Quaternions>& quaternions);

}  // namespace sim_core
