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

}  // namespace sim_core
