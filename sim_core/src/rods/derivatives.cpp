#include "rods/derivatives.hpp"

#include "math/lanes.hpp"
#include "rods/energy.hpp"

namespace sim_core {
namespace {

using T = Lanes<1>;

Eigen::Vector3d dense(Vec3<T> a) { return {a.x.v[0], a.y.v[0], a.z.v[0]}; }

Eigen::Matrix3d dense(Sym3<T> a) {
  Eigen::Matrix3d m;
  m << a.xx.v[0], a.xy.v[0], a.xz.v[0], a.xy.v[0], a.yy.v[0], a.yz.v[0], a.xz.v[0], a.yz.v[0], a.zz.v[0];
  return m;
}

Eigen::Matrix3d cross_matrix(const Eigen::Vector3d& a) {
  Eigen::Matrix3d m;
  m << 0.0, -a.z(), a.y(), a.z(), 0.0, -a.x(), -a.y(), a.x(), 0.0;
  return m;
}

}  // namespace

RodDerivatives rod_derivatives(double gamma, double phi0, double phi1, double twist_stiffness,
                               const Eigen::Ref<const Eigen::Matrix<double, -1, 4, Eigen::RowMajor>>& quaternions) {
  const int n = static_cast<int>(quaternions.rows()) - 1;
  const double h = 1.0 / n;
  const Rod<T> rod{gamma, phi0, phi1, twist_stiffness};
  const auto frame = [&](int i) {
    return Quat<T>{quaternions(i, 0), {quaternions(i, 1), quaternions(i, 2), quaternions(i, 3)}};
  };
  // The clamp's rows and columns are kept until the end, to assemble without exceptions.
  Eigen::VectorXd gradient = Eigen::VectorXd::Zero(3 * (n + 1));
  Eigen::MatrixXd hessian = Eigen::MatrixXd::Zero(3 * (n + 1), 3 * (n + 1));
  double energy = 0.0;
  for (int i = 0; i < n; ++i) {
    const Element<T> e = element(rod, element_moment(rod, frame(i), frame(i + 1), T(h), T(double(n))), T(double(n)));
    const Eigen::Vector3d f = dense(e.force);
    const Eigen::Matrix3d S = dense(e.stiffness), O = -S + 0.5 * cross_matrix(f);
    energy += e.energy.v[0];
    gradient.segment<3>(3 * i) -= f;
    gradient.segment<3>(3 * i + 3) += f;
    hessian.block<3, 3>(3 * i, 3 * i) += S;
    hessian.block<3, 3>(3 * i + 3, 3 * i + 3) += S;
    hessian.block<3, 3>(3 * i, 3 * i + 3) += O;
    hessian.block<3, 3>(3 * i + 3, 3 * i) += O.transpose();

    const double weight = gamma * (1.0 - i * h) * h;
    const Vec3<T> t = direction1(frame(i));
    energy += (i == 0 ? 0.5 : 1.0) * weight * t.z.v[0];
    gradient.segment<3>(3 * i) += dense(weight_torque(T(weight), t));
    hessian.block<3, 3>(3 * i, 3 * i) += dense(weight_stiffness(T(weight), t));
  }
  return {energy, gradient.tail(3 * n), hessian.bottomRightCorner(3 * n, 3 * n)};
}

}  // namespace sim_core
