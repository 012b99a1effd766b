#include "cloth/solver.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "cloth/control.hpp"
#include "cloth/kernels/choice.hpp"
#include "cloth/refusal.hpp"
#include "cloth/stepping.hpp"

namespace sim_core {

namespace {

// Solves with the matrix of the last evaluation, without contact.
struct LinearSolve {
  Assembly& assembly;
  ContactState open;
  StaleFactor factor;
  Buffer<float> work;

  LinearSolve(Assembly& assembly_in, const Buffer<double>& x, double dt)
      : assembly(assembly_in),
        open(assembly_in.numbering.free_nodes),
        factor(assembly_in.numbering),
        work((2 * krylov_max + 1) * 4L * assembly_in.numbering.free_nodes + 64, 0.0f) {
    factor.make(assembly, x, open, dt);
  }

  void solve(const Buffer<float>& b, Buffer<float>& x) {
    assembly.kernel.krylov(assembly.matrix, factor.view(), open.rows(), b.data(), x.data(), work.data(), krylov_max,
                           1e-3);
  }
};

}  // namespace

struct ClothSolver::Impl {
  Assembly assembly;
  Stepper stepper;
  StepController controller;
  Newton& newton;
  const Numbering& numbering;

  Impl(const Points2& rest, const Triangles& triangles, const ClothProperties& properties,
       const std::vector<std::int32_t>& held, const Edges& clamped, const ClothSettings& settings,
       const StepControl& control, const std::string& kernel)
      : assembly(cloth_kernel_named(kernel), ClothMesh(rest, triangles), properties, held, clamped),
        stepper(assembly, settings),
        controller(stepper, control),
        newton(stepper.newton),
        numbering(assembly.numbering) {}

  void load(const Points3& positions, const Points3& slopes, Buffer<double>& into) const {
    if (positions.rows() != numbering.vertices) refuse("positions: must have a row for each vertex");
    if (slopes.rows() != numbering.slopes) refuse("slopes: must have a row for each clamped edge");
    if (!positions.allFinite() || !slopes.allFinite()) refuse("positions: must be finite");
    for (int i = 0; i < numbering.vertices; ++i) at_node(into, numbering.node[i]) = positions.row(i).transpose();
    for (int i = 0; i < numbering.slopes; ++i) {
      at_node(into, numbering.node[numbering.vertices + i]) = slopes.row(i).transpose();
    }
  }

  Points3 unload(const Buffer<double>& from) const {
    Points3 out(numbering.vertices, 3);
    for (int i = 0; i < numbering.vertices; ++i) out.row(i) = at_node(from, numbering.node[i]).transpose();
    return out;
  }
};

ClothSolver::ClothSolver(const Points2& rest, const Triangles& triangles, const ClothProperties& properties,
                         const std::vector<std::int32_t>& held, const Edges& clamped, const ClothSettings& settings,
                         const StepControl& control, const std::string& kernel)
    : impl_(std::make_unique<Impl>(rest, triangles, properties, held, clamped, settings, control, kernel)) {}
ClothSolver::~ClothSolver() = default;

void ClothSolver::set_state(const Points3& positions, const Points3& velocities, const Points3& slopes) {
  impl_->load(positions, slopes, impl_->stepper.x);
  impl_->load(velocities, Points3::Zero(slopes.rows(), 3), impl_->stepper.v);
  impl_->stepper.restart();
  impl_->controller.restart();
}

StepReport ClothSolver::step(double dt, const Points3& gravity, const Points3& held, const Points3& slopes,
                             const std::vector<Body>& bodies, double damping) {
  return impl_->stepper.step(dt, {gravity, held, slopes, bodies, damping});
}

StepReport ClothSolver::advance(double begin, double end, const Motion& motion) {
  return impl_->controller.advance(begin, end, motion);
}

double ClothSolver::last_dt() const { return impl_->stepper.last_dt(); }
Eigen::Vector3d ClothSolver::momentum_rate() const { return impl_->stepper.momentum_rate(); }

Points3 ClothSolver::positions() const { return impl_->unload(impl_->stepper.x); }
Points3 ClothSolver::velocities() const { return impl_->unload(impl_->stepper.v); }
Points3 ClothSolver::reactions() const { return impl_->unload(impl_->newton.residual); }

std::vector<std::int32_t> ClothSolver::contacts() const {
  const Numbering& numbering = impl_->numbering;
  std::vector<std::int32_t> out(numbering.vertices, -1);
  for (int i = 0; i < numbering.free_nodes; ++i) out[numbering.vertex[i]] = impl_->newton.contact.touched[i];
  return out;
}

std::vector<std::int32_t> ClothSolver::sliding() const {
  const Numbering& numbering = impl_->numbering;
  std::vector<std::int32_t> out(numbering.vertices, 0);
  for (int i = 0; i < numbering.free_nodes; ++i) {
    out[numbering.vertex[i]] = impl_->newton.contact.mode[i] == contact_slip;
  }
  return out;
}

ClothSolver::Energies ClothSolver::energies(const Points3& positions, const Points3& slopes) {
  Buffer<double> at = impl_->stepper.x;
  impl_->load(positions, slopes, at);
  impl_->newton.evaluate(at, false);
  const Assembly& assembly = impl_->assembly;
  return {assembly.membrane_energy, assembly.bending_energy, impl_->unload(assembly.gradient)};
}

Points3 ClothSolver::stiffness_times(const Points3& positions, const Points3& slopes, const Points3& v) {
  const Numbering& numbering = impl_->numbering;
  Assembly& assembly = impl_->assembly;
  Buffer<double> at = impl_->stepper.x;
  impl_->load(positions, slopes, at);
  assembly.definite = false;
  assembly.exact = true;
  impl_->newton.evaluate(at, true);
  assembly.exact = false;
  assembly.clear_diagonal();
  Buffer<float> in(4 * numbering.free_nodes), out(4 * numbering.free_nodes);
  for (int i = 0; i < numbering.free_nodes; ++i) {
    at_node(in, i) = v.row(numbering.vertex[i]).transpose().cast<float>();
  }
  assembly.kernel.apply(assembly.matrix, in.data(), out.data());
  Points3 result = Points3::Zero(numbering.vertices, 3);
  for (int i = 0; i < numbering.free_nodes; ++i) {
    result.row(numbering.vertex[i]) = at_node(out, i).cast<double>().transpose();
  }
  return result;
}

// Inverse iteration: v <- (K + M/T^2)^-1 M v tends to the softest mode, and 1/growth - 1/T^2 to its eigenvalue.
double ClothSolver::softest(const Points3& positions, const Points3& slopes) {
  constexpr double period = 0.3;  // T, s
  constexpr int iterations = 40;
  Assembly& assembly = impl_->assembly;
  const int free_nodes = impl_->numbering.free_nodes;
  Buffer<double> at = impl_->stepper.x;
  impl_->load(positions, slopes, at);
  assembly.read_table(at);
  assembly.set_diagonal(period, 0.0);
  assembly.definite = false;
  impl_->newton.evaluate(at, true);
  LinearSolve linear(assembly, at, period);
  Buffer<float> v(4L * free_nodes + 64, 0.0f), y(v);
  for (int i = 0; i < free_nodes; ++i) at_node(v, i).setConstant(1.0f + 0.1f * static_cast<float>(i % 7));
  double value = 0.0;
  for (int iteration = 0; iteration < iterations; ++iteration) {
    double size = 0.0, growth = 0.0;
    for (int i = 0; i < free_nodes; ++i) size += assembly.mass[i] * at_node(v, i).cast<double>().squaredNorm();
    const float scale = static_cast<float>(1.0 / std::sqrt(size));
    for (float& component : v) component *= scale;
    Buffer<float> force = v;
    for (int i = 0; i < free_nodes; ++i) at_node(force, i) *= static_cast<float>(assembly.mass[i]);
    linear.solve(force, y);
    for (int i = 0; i < free_nodes; ++i) {
      growth += assembly.mass[i] * at_node(v, i).cast<double>().dot(at_node(y, i).cast<double>());
    }
    value = 1.0 / growth - 1.0 / (period * period);
    v = y;
  }
  return value;
}

double ClothSolver::factor_error(const Points3& positions, const Points3& slopes, double dt) {
  Assembly& assembly = impl_->assembly;
  Newton& newton = impl_->newton;
  const int free_nodes = impl_->numbering.free_nodes;
  Buffer<double> at = impl_->stepper.x;
  impl_->load(positions, slopes, at);
  assembly.set_diagonal(dt, 0.0);
  newton.evaluate(at, true);
  std::fill(newton.contact.mode.begin(), newton.contact.mode.end(), static_cast<int>(contact_open));
  StaleFactor& factor = newton.factors.latest();
  factor.make(assembly, at, newton.contact, dt);
  factor.forget();
  Buffer<float> v(4 * free_nodes), b(4 * free_nodes);
  unsigned state = 1;
  for (int i = 0; i < free_nodes; ++i) {
    for (int c = 0; c < 3; ++c) {
      state = state * 1664525u + 1013904223u;
      v[4 * i + c] = static_cast<float>(state >> 8) / (1 << 23) - 1.0f;
    }
  }
  NeighbourNumbers numbers;
  assembly.kernel.apply(assembly.neighbour(at, numbers), v.data(), b.data());
  assembly.kernel.solve(factor.view(), free_nodes, b.data(), b.data());
  double wrong = 0.0, size = 0.0;
  for (std::size_t i = 0; i < v.size(); ++i) {
    wrong += (v[i] - b[i]) * (v[i] - b[i]);
    size += v[i] * v[i];
  }
  return std::sqrt(wrong / size);
}

std::pair<double, double> ClothSolver::part_error(const std::vector<std::int32_t>& sticking, double dt) {
  const Buffer<double>& x = impl_->stepper.x;
  Assembly& assembly = impl_->assembly;
  assembly.set_diagonal(dt, 0.0);
  impl_->newton.evaluate(x, true);
  ContactState contact(impl_->numbering.free_nodes);
  StaleFactor part(impl_->numbering), whole(impl_->numbering);
  ClothSettings settings{};
  settings.refactor_after = settings.krylov_max = krylov_max;
  part.renew(assembly, x, contact, dt, settings);
  for (const std::int32_t vertex : sticking) contact.mode[impl_->numbering.node[vertex]] = contact_stick;
  const double share = part.renew(assembly, x, contact, dt, settings);
  whole.renew(assembly, x, contact, dt, settings);
  float wrong = 0.0f, size = 0.0f;
  for (std::size_t i = 0; i < whole.storage().tiles.size(); ++i) {
    wrong = std::max(wrong, std::abs(whole.storage().tiles[i] - part.storage().tiles[i]));
    size = std::max(size, std::abs(whole.storage().tiles[i]));
  }
  return {wrong / size, share};
}

const Eigen::VectorXd& ClothSolver::masses() const { return impl_->assembly.mass_of_vertex; }
ClothPhases ClothSolver::phases() const { return impl_->newton.phases; }
double ClothSolver::factor_flops() const {
  const std::vector<double>& work = impl_->newton.factors.latest().storage().work;
  return std::accumulate(work.begin(), work.end(), 0.0);
}
std::size_t ClothSolver::factor_floats() const { return impl_->newton.factors.latest().storage().tiles.size(); }
std::string ClothSolver::kernel() const { return impl_->assembly.kernel.name; }

}  // namespace sim_core
