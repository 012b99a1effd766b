// One chain of a general rod on its own, for fits: equilibrium from given frames, nodal positions, and their exact
// derivatives by weight and natural curvature.
//
// At equilibrium g(omega, p) = 0, so that omega' = -H^{-1} dg/dp with the Hessian that Newton's method factors anyway.
// A fit has more residuals (3 per point) than parameters, so these forward sensitivities are cheaper than adjoints.
#pragma once

#include <Eigen/Core>

namespace sim_core {

using Rows3 = Eigen::Matrix<double, -1, 3, Eigen::RowMajor>;
using Rows4 = Eigen::Matrix<double, -1, 4, Eigen::RowMajor>;
using RowMajor = Eigen::Matrix<double, -1, -1, Eigen::RowMajor>;

struct RodChain {
  double gamma;               // rho A g L^3 / EI
  Eigen::Vector3d stiffness;  // EI
  Rows3 natural;              // (N, 3): natural curvature at the middle of each element, 1/L
};

struct ChainEquilibrium {
  Rows4 quaternions;  // (N + 1, 4)
  double energy;      // EI/L
  bool converged, stable;
};

// Minimise from `quaternions`: (N + 1, 4), rows (w, x, y, z), unit, without jumps of sign; the clamp first.
ChainEquilibrium relax_chain(const RodChain& chain, const Rows4& quaternions);

// Frames of the chain with this curvature in its elements: (N + 1, 4) from (N, 3).
Rows4 chain_frames(const Rows3& curvature, const Eigen::Vector4d& clamp);

// Positions of the nodes, r' = t by the trapezoidal rule, which keeps the error even in h: (N + 1, 3), L.
Rows3 chain_centerline(const Rows4& quaternions);

// Derivatives of the positions of every `stride`-th node: (3 (N / stride + 1), 1 + 3 B), rows point-major. Column 0 is
// by gamma; column 1 + c B + b by the coefficient b of component c of the natural curvature, whose values in the
// elements are basis (N, B) times the coefficients. The chain must be at a stable equilibrium.
RowMajor chain_jacobian(const RodChain& chain, const Rows4& quaternions, const RowMajor& basis, int stride);

}  // namespace sim_core
