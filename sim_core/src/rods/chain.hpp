// One chain of a rod on its own, for protocols and fits: equilibrium from given frames, nodal
// positions, and derivatives.
//
// At equilibrium g(omega, p) = 0, so that omega' = -H^{-1} dg/dp with the Hessian that Newton's
// method factors anyway. A fit has more residuals (3 per point) than parameters, so these forward
// sensitivities are cheaper than adjoints.
//
// Quaternions are (N + 1, 4), rows (w, x, y, z), unit, without jumps of sign; the first, the clamp,
// stays.
#pragma once

#include <Eigen/Core>
#include <utility>

#include "math/lanes.hpp"

namespace sim_core {

using Rows3 = Eigen::Matrix<double, -1, 3, Eigen::RowMajor>;
using Rows4 = Eigen::Matrix<double, -1, 4, Eigen::RowMajor>;
using RowMajor = Eigen::Matrix<double, -1, -1, Eigen::RowMajor>;

// The equilibrium next to `quaternions`, and whether it is one with a positive definite Hessian.
// relax_rod: of a uniform round rod, whose certificate is that of the frames it returns.
// relax_chain: with the natural curvature (N, 3) in the middle of each element [1/L] and the
// stiffness K [EI]; its certificate is that of the frames before the last step.
std::pair<Rows4, bool> relax_rod(double gamma, double phi0, double phi1, double twist_stiffness,
                                 const Rows4& quaternions);
std::pair<Rows4, bool> relax_chain(double gamma, const Eigen::Vector3d& stiffness,
                                   const Rows3& natural, const Rows4& quaternions);

// Frames of the chain with this curvature in its elements: (N + 1, 4) from (N, 3).
Rows4 chain_frames(const Rows3& curvature, const Eigen::Vector4d& clamp);

// Positions of the nodes, r' = t by the trapezoidal rule, which keeps the error even in h: (N + 1,
// 3), L.
Rows3 chain_centerline(const Rows4& quaternions);

// Derivatives of the positions of every `stride`-th node: (3 (N / stride + 1), 1 + 3 B), rows
// point-major. Column 0 is by gamma; column 1 + c B + b by the coefficient b of component c of the
// natural curvature, whose values in the elements are basis (N, B) times the coefficients. The
// chain must be at a stable equilibrium.
RowMajor chain_jacobian(double gamma, const Eigen::Vector3d& stiffness, const Rows3& natural,
                        const Rows4& quaternions, const RowMajor& basis, int stride);

// Derivatives of an energy, of one lane, as matrices.
inline Eigen::Vector3d dense(Vec3<Lanes<1>> a) { return {a.x.v[0], a.y.v[0], a.z.v[0]}; }

inline Eigen::Matrix3d dense(Sym3<Lanes<1>> a) {
  Eigen::Matrix3d m;
  m << a.xx.v[0], a.xy.v[0], a.xz.v[0], a.xy.v[0], a.yy.v[0], a.yz.v[0], a.xz.v[0], a.yz.v[0],
      a.zz.v[0];
  return m;
}

inline Eigen::Matrix3d cross_matrix(const Eigen::Vector3d& a) {
  Eigen::Matrix3d m;
  m << 0.0, -a.z(), a.y(), a.z(), 0.0, -a.x(), -a.y(), a.x(), 0.0;
  return m;
}

}  // namespace sim_core
