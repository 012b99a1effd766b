// The linear problem of an iteration: GMRES on stale factors, with the active set of contacts. The
// product of the matrix with a vector, friction included, is in kernels/krylov.hpp.
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "cloth/constants.hpp"
#include "cloth/newton.hpp"

namespace sim_core {

using Eigen::Vector3d;

LinearSolver::LinearSolver(Assembly& assembly, const ClothSettings& settings, ContactState& contact)
    : factors(assembly.numbering),
      step(4L * assembly.numbering.free_nodes + 64, 0.0f),
      assembly_(assembly),
      settings_(settings),
      contact_(contact),
      work_((2 * krylov_max + 1) * 4L * assembly.numbering.free_nodes + 64, 0.0f),
      image_(step) {}

bool LinearSolver::solve(ContactSet* pairs, const Buffer<double>& x, double dt,
                         StepReport& report) {
  if (pairs) force_ = contact_.force;
  step = contact_.correction;
  if (!pairs || !pairs->active()) {
    StaleFactor& factor = factors.latest();
    report.factorizations += factor.renew(assembly_, x, contact_, dt, settings_);
    factor.age.spent(solve_linear(pairs, factor.view(), settings_.krylov_tolerance, report));
  } else {
    pair_factor_.age.spent(solve_with_pairs(*pairs, x, dt, report));
  }
  if (!pairs) return false;
  int round = 0;
  if (pairs->smoothing == 0.0) {
    for (; round < newton::rounds_max && pairs->activate(step); ++round)
      solve_with_pairs(*pairs, x, dt, report);
  }
  pairs->solved(step);
  return round == newton::rounds_max;
}

const Factor* LinearSolver::factor_at_hand(double dt, bool with_pairs) {
  if (with_pairs) return pair_factor_.age.fits(dt) ? &pair_factor_.view() : nullptr;
  return factors.latest().age.fits(dt) ? &factors.latest().view() : nullptr;
}

int LinearSolver::solve_with_pairs(ContactSet& pairs, const Buffer<double>& x, double dt,
                                   StepReport& report) {
  report.factorizations += pair_factor_.renew(assembly_, x, contact_, pairs, dt, settings_);
  contact_.force = force_;
  pair_rows_ = pairs.rows();
  assembly_.matrix.pairs = &pair_rows_;
  const double tolerance = pairs.smoothing > 0.0
                               ? newton::smoothed_tolerance
                               : std::min(settings_.krylov_tolerance, newton::pairs_tolerance);
  const int iterations = solve_linear(&pairs, pair_factor_.view(), tolerance, report);
  assembly_.matrix.pairs = nullptr;
  return iterations;
}

int LinearSolver::solve_linear(const ContactSet* pairs, const Factor& factor,
                               double krylov_tolerance, StepReport& report) {
  subtract_corrections(pairs);
  double size = 0.0;
  for (float f : contact_.force) size += static_cast<double>(f) * f;
  size = std::sqrt(size);
  const double tolerance = std::max(
      krylov_tolerance, newton::linear_fraction * settings_.tolerance / std::max(size, 1e-300));
  for (int i = 0; i < 4 * assembly_.numbering.free_nodes; ++i) step[i] -= contact_.correction[i];
  const int iterations =
      assembly_.kernel.krylov(assembly_.matrix, factor, contact_.rows(), contact_.force.data(),
                              step.data(), work_.data(), std::min(tolerance, 0.5));
  for (int i = 0; i < 4 * assembly_.numbering.free_nodes; ++i) step[i] += contact_.correction[i];
  report.krylov += iterations;
  return iterations;
}

// What contact prescribes, `correction`, goes to the right-hand side, and the forces of pairs that
// do not depend on the free nodes.
void LinearSolver::subtract_corrections(const ContactSet* pairs) {
  const Buffer<float>& correction = contact_.correction;
  const bool with_pairs = assembly_.matrix.pairs != nullptr;
  if (!with_pairs &&
      std::all_of(correction.begin(), correction.end(), [](float c) { return c == 0.0f; }))
    return;
  assembly_.kernel.apply(assembly_.matrix, correction.data(), image_.data());
  if (with_pairs) pairs->subtract_right_side(image_);
  for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
    if (contact_.mode[i] == contact_stick) continue;
    auto force = at_node(contact_.force, i), pulled = at_node(image_, i);
    if (contact_.mode[i] == contact_open) {
      force -= pulled;
      continue;
    }
    const auto n = at_node(contact_.normal, i), t = at_node(contact_.direction, i);
    const float normal_force = n.dot(pulled);
    force -= pulled - normal_force * n - contact_.coupling[i] * normal_force * t;
  }
}

}  // namespace sim_core
