#include "rods/rods.hpp"

#include <Eigen/LU>
#include <vector>

#include "math/refusal.hpp"
#include "rods/chain.hpp"
#include "rods/general_rod.hpp"
#include "rods/newton.hpp"

namespace sim_core {
namespace {

using T = Lanes<1>;

constexpr double chain_tolerance =
    1e-6;  // on the last Newton step [rad]; the error left is of the order of its square

Vec3<T> lanes(const Eigen::Vector3d& a) { return {a.x(), a.y(), a.z()}; }

Quat<T> frame(const Rows4& q, Eigen::Index i) { return {q(i, 0), {q(i, 1), q(i, 2), q(i, 3)}}; }

void set_frame(Rows4& rows, Eigen::Index i, Quat<T> q) {
  rows.row(i) << q.w.v[0], q.v.x.v[0], q.v.y.v[0], q.v.z.v[0];
}

void check_rows(const char* name, Eigen::Index rows, Eigen::Index asked) {
  if (rows != asked || asked < 1) refuse(text(name, ": must have ", asked, " rows, got ", rows));
}

// `again`: from the equilibrium, too. The certificate is that of the frames before the last step.
template <class AnyRod>
std::pair<Rows4, bool> relaxed(const AnyRod& rod, const Rows4& quaternions, bool again) {
  const int n = static_cast<int>(quaternions.rows()) - 1;
  Level<1> level{n, std::vector<Quat<T>>(n + 1), {}};
  for (int i = 0; i <= n; ++i) level.frame[i] = frame(quaternions, i);
  NewtonWorkspace<1> work(n);
  minimise(rod, level, work, chain_tolerance);
  if (again && level.converged.v[0] != 0) minimise(rod, level, work, chain_tolerance);
  Rows4 rows(n + 1, 4);
  for (int i = 0; i <= n; ++i) set_frame(rows, i, level.frame[i]);
  return {rows, level.stable.v[0] != 0};
}

}  // namespace

int default_start_level(int elements) {
  constexpr int start_elements_min = 24;
  int level = 0;
  while (level < 2 && (elements >> (2 - level)) < start_elements_min) ++level;
  return level;
}

void check_settings(const RodSettings& settings, int points, double curvature_max) {
  if (points < 2) refuse(text("points: must be at least 2, got ", points));
  if (settings.elements < elements_min || settings.elements % 4 != 0) {
    refuse(text("elements: must be a multiple of 4 and at least ", elements_min, ", got ",
                settings.elements));
  }
  if (settings.start_level < 0 || settings.start_level > 2) {
    refuse(text("start_level: must be 0, 1 or 2, got ", settings.start_level));
  }
  if (curvature_max > element_turn_max * (settings.elements / 4)) {
    refuse(text("elements: must be at least 4 |natural curvature| / ", element_turn_max,
                " so that every element turns by less than half a turn, got ", settings.elements,
                " for |natural curvature| = ", curvature_max));
  }
}

std::vector<SamplePoint> sample_points(int points, int elements) {
  const int nodes = elements / 2;
  const double h = 1.0 / nodes;
  std::vector<SamplePoint> samples(points);
  for (int j = 0; j < points; ++j) {
    // Integers first: whole nodes are hit exactly.
    const std::int64_t product = static_cast<std::int64_t>(j) * nodes;
    std::int64_t node = product / (points - 1);
    if (node == nodes) node = nodes - 1;
    const double x = static_cast<double>(product - node * (points - 1)) / (points - 1),
                 x3 = x * x * x;
    const double y = 1.0 - x, y3 = y * y * y;
    samples[j] = {static_cast<int>(node),
                  {y3 * (1.0 + x * (3.0 + 6.0 * x)), h * (y3 * x * (1.0 + 3.0 * x)),
                   h * h * (0.5 * y3 * x * x), x3 * (1.0 + y * (3.0 + 6.0 * y)),
                   -h * (x3 * y * (1.0 + 3.0 * y)), h * h * (0.5 * x3 * y * y)}};
  }
  return samples;
}

std::pair<Rows4, bool> relax_rod(double gamma, double phi0, double phi1, double twist_stiffness,
                                 const Rows4& quaternions) {
  if (quaternions.rows() < 2)
    refuse(text("quaternions: must have at least 2 rows, got ", quaternions.rows()));
  return relaxed(Rod<T>{gamma, phi0, phi1, twist_stiffness}, quaternions, true);
}

std::pair<Rows4, bool> relax_chain(double gamma, const Eigen::Vector3d& stiffness,
                                   const Rows3& natural, const Rows4& quaternions) {
  const int n = static_cast<int>(natural.rows());
  check_rows("quaternions", quaternions.rows(), n + 1);
  // A chain reads the middles of its elements only: every second value of the grid.
  std::vector<Vec3<T>> grid(2 * n + 1, Vec3<T>{T(0.0), T(0.0), T(0.0)});
  for (int i = 0; i < n; ++i) grid[2 * i + 1] = lanes(natural.row(i));
  const GeneralRod<T> rod{gamma,   lanes(stiffness), frame(quaternions, 0),
                          2 * n,   grid.data(),      nullptr,
                          nullptr, nullptr};
  return relaxed(rod, quaternions, false);
}

Rows4 chain_frames(const Rows3& curvature, const Eigen::Vector4d& clamp) {
  const Eigen::Index n = curvature.rows();
  Rows4 rows(n + 1, 4);
  rows.row(0) = clamp;
  for (Eigen::Index i = 0; i < n; ++i) {
    const Vec3<T> turn = lanes(curvature.row(i) / static_cast<double>(n));
    set_frame(rows, i + 1, renormalized(frame(rows, i) * exponential(turn)));
  }
  return rows;
}

Rows3 chain_centerline(const Rows4& quaternions) {
  const Eigen::Index n = quaternions.rows() - 1;
  Rows3 r(n + 1, 3);
  r.row(0).setZero();
  Eigen::Vector3d before = dense(direction1(frame(quaternions, 0)));
  for (Eigen::Index i = 1; i <= n; ++i) {
    const Eigen::Vector3d here = dense(direction1(frame(quaternions, i)));
    r.row(i) = r.row(i - 1) + (0.5 / n) * (before + here).transpose();
    before = here;
  }
  return r;
}

RowMajor chain_jacobian(double gamma, const Eigen::Vector3d& stiffness, const Rows3& natural,
                        const Rows4& quaternions, const RowMajor& basis, int stride) {
  const int n = static_cast<int>(natural.rows());
  check_rows("quaternions", quaternions.rows(), n + 1);
  check_rows("basis", basis.rows(), n);
  const Eigen::Index columns = 1 + 3 * basis.cols();
  const double h = 1.0 / n;
  std::vector<Eigen::Matrix3d> diagonal(n + 1, Eigen::Matrix3d::Zero()), upper(n);
  RowMajor turn =
      RowMajor::Zero(3 * (n + 1), columns);  // -dg/dp, then omega'; the clamp's rows are dropped
  for (int i = 0; i < n; ++i) {
    const Quat<T> a = frame(quaternions, i), b = frame(quaternions, i + 1);
    const GeneralSection<T> here{lanes(natural.row(i)), lanes(stiffness), {}};
    const auto moment = element_moment(here, a, b, T(h), T(double(n)));
    const Element<T> e = element(here, moment, T(double(n)));
    const Vec3<T> t = direction1(a);
    const T load((1.0 - i * h) * h);
    const Eigen::Matrix3d S = dense(e.stiffness);
    diagonal[i] += S + dense(weight_stiffness(T(gamma) * load, t));
    diagonal[i + 1] += S;
    upper[i] = -S + 0.5 * cross_matrix(dense(e.force));
    turn.block<3, 1>(3 * i, 0) -= dense(weight_torque(load, t));
    // f = J^T R K (theta / h - kappa_bar): its derivative by component c is -K_c J^T d_c.
    const Vec3<T> directions[3] = {direction1(b), direction2(b), direction3(b)};
    for (int c = 0; c < 3; ++c) {
      const Eigen::Vector3d f =
          stiffness[c] * dense(jacobian_transposed(moment.log, directions[c]));
      const auto part = f * basis.row(i);
      turn.block(3 * i, 1 + c * basis.cols(), 3, basis.cols()) -= part;
      turn.block(3 * i + 3, 1 + c * basis.cols(), 3, basis.cols()) += part;
    }
  }
  turn.topRows<3>().setZero();
  std::vector<Eigen::Matrix3d> inverse(n + 1);
  for (int i = 1; i <= n; ++i) {
    if (i > 1) {
      const Eigen::Matrix3d ratio = upper[i - 1].transpose() * inverse[i - 1];
      diagonal[i] -= ratio * upper[i - 1];
      turn.middleRows<3>(3 * i).noalias() -= ratio * turn.middleRows<3>(3 * i - 3);
    }
    inverse[i] = diagonal[i].inverse();
  }
  for (int i = n; i >= 1; --i) {
    if (i < n) turn.middleRows<3>(3 * i).noalias() -= upper[i] * turn.middleRows<3>(3 * i + 3);
    turn.middleRows<3>(3 * i) = (inverse[i] * turn.middleRows<3>(3 * i)).eval();
  }

  RowMajor jacobian(3 * (n / stride + 1), columns);
  RowMajor position = RowMajor::Zero(3, columns), before = RowMajor::Zero(3, columns);
  jacobian.topRows<3>().setZero();
  for (int i = 1; i <= n; ++i) {
    // t' = omega' x t
    const RowMajor here =
        -cross_matrix(dense(direction1(frame(quaternions, i)))) * turn.middleRows<3>(3 * i);
    position += (0.5 * h) * (before + here);
    before = here;
    if (i % stride == 0) jacobian.middleRows<3>(3 * (i / stride)) = position;
  }
  return jacobian;
}

}  // namespace sim_core
