#include "cloth/correction.hpp"

#include <algorithm>
#include <cmath>

namespace sim_core {

Correction::Correction(Assembly& assembly, const ClothSettings& settings, const Constants& constants,
                       ContactState& contact)
    : factors(assembly.numbering, constants.factor.pool),
      change(4L * assembly.numbering.free_nodes + 64, 0.0f),
      assembly_(assembly),
      settings_(settings),
      constants_(constants.newton),
      contact_(contact),
      pair_factor_(constants.factor),
      work_((2 * krylov_max + 1) * 4L * assembly.numbering.free_nodes + 64, 0.0f),
      image_(change) {}

bool Correction::solve(ContactSet* pairs, const Buffer<double>& x, double dt, StepReport& report) {
  if (pairs) force_ = contact_.force;
  if (!pairs || !pairs->active()) {
    StaleFactor& factor = factors.latest();
    report.factorizations += factor.renew(assembly_, x, contact_, dt, settings_);
    const int iterations = solve_linear(pairs, factor.view(), settings_.krylov_tolerance);
    factor.spent(iterations);
    report.krylov += iterations;
  } else {
    solve_with_pairs(*pairs, x, dt, report);
  }
  if (!pairs) return false;
  int round = 0;
  if (pairs->smoothing == 0.0) {
    for (; round < constants_.rounds_max && pairs->activate(change); ++round) solve_with_pairs(*pairs, x, dt, report);
  }
  pairs->solved(change);
  return round == constants_.rounds_max;
}

void Correction::solve_with_pairs(ContactSet& pairs, const Buffer<double>& x, double dt, StepReport& report) {
  report.factorizations += pair_factor_.renew(assembly_, x, contact_, pairs, dt, settings_);
  contact_.force = force_;
  pair_rows_ = pairs.rows();
  assembly_.matrix.pairs = &pair_rows_;
  const double tolerance = pairs.smoothing > 0.0 ? constants_.smooth_tolerance
                                                 : std::min(settings_.krylov_tolerance, constants_.pairs_tolerance);
  const int iterations = solve_linear(&pairs, pair_factor_.view(), tolerance);
  assembly_.matrix.pairs = nullptr;
  pair_factor_.spent(iterations);
  report.krylov += iterations;
}

int Correction::solve_linear(const ContactSet* pairs, const Factor& factor, double krylov_tolerance) {
  subtract_corrections(pairs);
  double size = 0.0;
  for (float f : contact_.force) size += static_cast<double>(f) * f;
  size = std::sqrt(size);
  const double tolerance =
      std::max(krylov_tolerance, constants_.linear_share * settings_.tolerance / std::max(size, 1e-300));
  const int iterations =
      assembly_.kernel.krylov(assembly_.matrix, factor, contact_.rows(), contact_.force.data(), change.data(),
                              work_.data(), settings_.krylov_max, std::min(tolerance, 0.5));
  for (int i = 0; i < 4 * assembly_.numbering.free_nodes; ++i) change[i] += contact_.correction[i];
  return iterations;
}

// What contact prescribes, `correction`, goes to the right-hand side, and the forces of pairs that do not depend on the
// free nodes.
void Correction::subtract_corrections(const ContactSet* pairs) {
  const Buffer<float>& correction = contact_.correction;
  const bool with_pairs = assembly_.matrix.pairs != nullptr;
  if (!with_pairs && std::all_of(correction.begin(), correction.end(), [](float c) { return c == 0.0f; })) return;
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
    const float pressing = n.dot(pulled);
    force -= pulled - pressing * n - contact_.mu[i] * pressing * t;
  }
}

}  // namespace sim_core
