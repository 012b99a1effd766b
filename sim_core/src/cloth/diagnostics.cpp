#include "cloth/diagnostics.hpp"

#include <algorithm>
#include <cmath>

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

Buffer<float> stiffness_times(Assembly& assembly, Newton& newton, const Buffer<double>& x, const Buffer<float>& v) {
  assembly.definite = false;
  assembly.exact = true;
  newton.evaluate(x, true);
  assembly.exact = false;
  assembly.clear_diagonal();
  Buffer<float> out(v.size());
  assembly.kernel.apply(assembly.matrix, v.data(), out.data());
  return out;
}

// Inverse iteration: v <- (K + M/T^2)^-1 M v tends to the softest mode, and 1/growth - 1/T^2 to its eigenvalue.
double softest_mode(Assembly& assembly, Newton& newton, const Buffer<double>& x) {
  constexpr double period = 0.3;  // T, s
  constexpr int iterations = 40;
  const int free_nodes = assembly.numbering.free_nodes;
  assembly.set_diagonal(period, 0.0);
  assembly.definite = false;
  newton.evaluate(x, true);
  LinearSolve linear(assembly, x, period);
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

double factor_error(Assembly& assembly, Newton& newton, const Buffer<double>& x, double dt) {
  const int free_nodes = assembly.numbering.free_nodes;
  assembly.set_diagonal(dt, 0.0);
  newton.evaluate(x, true);
  std::fill(newton.contact.mode.begin(), newton.contact.mode.end(), static_cast<int>(contact_open));
  StaleFactor& factor = newton.correction.factors.latest();
  factor.make(assembly, x, newton.contact, dt);
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
  assembly.kernel.apply(assembly.neighbour(x, numbers), v.data(), b.data());
  assembly.kernel.solve(factor.view(), free_nodes, b.data(), b.data());
  double wrong = 0.0, size = 0.0;
  for (std::size_t i = 0; i < v.size(); ++i) {
    wrong += (v[i] - b[i]) * (v[i] - b[i]);
    size += v[i] * v[i];
  }
  return std::sqrt(wrong / size);
}

std::pair<double, double> part_error(Assembly& assembly, Newton& newton, const Buffer<double>& x,
                                     const std::vector<int>& sticking, double dt) {
  assembly.set_diagonal(dt, 0.0);
  newton.evaluate(x, true);
  ContactState contact(assembly.numbering.free_nodes);
  StaleFactor part(assembly.numbering), whole(assembly.numbering);
  ClothSettings settings{};
  settings.refactor_after = settings.krylov_max = krylov_max;
  part.renew(assembly, x, contact, dt, settings);
  for (const int node : sticking) contact.mode[node] = contact_stick;
  const double share = part.renew(assembly, x, contact, dt, settings);
  whole.renew(assembly, x, contact, dt, settings);
  float wrong = 0.0f, size = 0.0f;
  for (std::size_t i = 0; i < whole.storage().tiles.size(); ++i) {
    wrong = std::max(wrong, std::abs(whole.storage().tiles[i] - part.storage().tiles[i]));
    size = std::max(size, std::abs(whole.storage().tiles[i]));
  }
  return {wrong / size, share};
}

}  // namespace sim_core
