#include "rods/relax.hpp"

#include <stdexcept>
#include <string>

#include "math/lanes.hpp"
#include "rods/levels.hpp"
#include "rods/newton.hpp"

namespace sim_core {
namespace {

using T = Lanes<1>;

// Tolerance on the last Newton step [rad]; the error left is of the order of the square.
constexpr double tolerance = 1e-6;

}  // namespace

RelaxedRod relax_rod(double gamma, double phi0, double phi1, double twist_stiffness,
                     const Eigen::Ref<const Quaternions>& quaternions) {
  const int n = static_cast<int>(quaternions.rows()) - 1;
  if (n < 1) {
    throw std::invalid_argument("quaternions: must have at least 2 rows, got " + std::to_string(quaternions.rows()));
  }
  const Rod<T> rod{gamma, phi0, phi1, twist_stiffness};
  Level<1> level{n, std::vector<Quat<T>>(n + 1), std::vector<Vec3<T>>(n + 1)};
  for (int i = 0; i <= n; ++i) {
    level.frame[i] = {quaternions(i, 0), {quaternions(i, 1), quaternions(i, 2), quaternions(i, 3)}};
  }
  NewtonWorkspace<1> work(n);
  minimise(rod, level, work, tolerance);
  double iterations = level.sweeps.v[0];
  // The certificate is that of the frames before the last step. A second pass starts, and ends, at equilibrium itself.
  if (level.converged.v[0] != 0) {
    minimise(rod, level, work, tolerance);
    iterations += level.sweeps.v[0];
  }
  balance(rod, level);
  RelaxedRod result{Quaternions(n + 1, 4),        level.energy.v[0],         level.residual.v[0],
                    static_cast<int>(iterations), level.converged.v[0] != 0, level.stable.v[0] != 0};
  for (int i = 0; i <= n; ++i) {
    const Quat<T> q = level.frame[i];
    result.quaternions.row(i) << q.w.v[0], q.v.x.v[0], q.v.y.v[0], q.v.z.v[0];
  }
  return result;
}

}  // namespace sim_core
