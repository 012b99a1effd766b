#include "cloth/newton.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace sim_core {

using Eigen::Vector3d;

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
  change = contact_.correction;
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
    for (; round < constants_.rounds_max && pairs->activate(change); ++round) solve_with_pairs(*pairs, x, dt, report);
  }
  pairs->solved(change);
  return round == constants_.rounds_max;
}

int Correction::solve_with_pairs(ContactSet& pairs, const Buffer<double>& x, double dt, StepReport& report) {
  report.factorizations += pair_factor_.renew(assembly_, x, contact_, pairs, dt, settings_);
  contact_.force = force_;
  pair_rows_ = pairs.rows();
  assembly_.matrix.pairs = &pair_rows_;
  const double tolerance = pairs.smoothing > 0.0 ? constants_.smooth_tolerance
                                                 : std::min(settings_.krylov_tolerance, constants_.pairs_tolerance);
  const int iterations = solve_linear(&pairs, pair_factor_.view(), tolerance, report);
  assembly_.matrix.pairs = nullptr;
  return iterations;
}

int Correction::solve_linear(const ContactSet* pairs, const Factor& factor, double krylov_tolerance,
                             StepReport& report) {
  subtract_corrections(pairs);
  double size = 0.0;
  for (float f : contact_.force) size += static_cast<double>(f) * f;
  size = std::sqrt(size);
  const double tolerance =
      std::max(krylov_tolerance, constants_.linear_share * settings_.tolerance / std::max(size, 1e-300));
  for (int i = 0; i < 4 * assembly_.numbering.free_nodes; ++i) change[i] -= contact_.correction[i];
  const int iterations =
      assembly_.kernel.krylov(assembly_.matrix, factor, contact_.rows(), contact_.force.data(), change.data(),
                              work_.data(), settings_.krylov_max, std::min(tolerance, 0.5));
  for (int i = 0; i < 4 * assembly_.numbering.free_nodes; ++i) change[i] += contact_.correction[i];
  report.krylov += iterations;
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

Newton::Newton(Assembly& assembly, const ClothSettings& settings, const Constants& constants)
    : contact(assembly.numbering.free_nodes, constants.contact),
      correction(assembly, settings, constants, contact),
      residual(4L * assembly.numbering.nodes, 0.0),
      assembly_(assembly),
      settings_(settings),
      constants_(constants.newton),
      law_stiffness_(constants.contact.law_stiffness),
      length_tolerance_(constants.contact.length_tolerance),
      trial_(residual),
      best_(residual) {}

// R = M ((x - x_inertial)/dt^2 + c (x - x_start)/dt) + grad E, and the branch of each contact's law.
Norms Newton::look(const StepProblem& problem, const Buffer<double>& x, double share) {
  const double inertia = 1.0 / (problem.dt * problem.dt);
  for (int i = 0; i < assembly_.numbering.nodes; ++i) {
    const double viscous = (problem.damping + assembly_.own_damping[i]) / problem.dt;
    at_node(residual, i) = assembly_.mass[i] * (inertia * (at_node(x, i) - at_node(problem.inertial, i)) +
                                                viscous * (at_node(x, i) - at_node(problem.start, i))) +
                           at_node(assembly_.gradient, i);
  }
  if (pairs) pairs->update(x, share, residual);
  if (contact.surfaces) {  // those that push cloth together hold it as stiffly as pairs do
    contact.stiffness = own_stiffness_;
    pairs->add_stiffness(law_stiffness_, contact.stiffness);
  }
  Norms norms = contact.sort(x, problem.start, residual, problem.at_start, problem.at_end);
  if (pairs) pairs->count_errors(settings_.tolerance / length_tolerance_, norms);
  return norms;
}

// Whether held nodes are at their ends.
bool Newton::arrived(const Buffer<double>& x) const {
  return !pairs || std::equal(x.begin() + 4L * assembly_.numbering.free_nodes, x.end(),
                              ends_.begin() + 4L * assembly_.numbering.free_nodes);
}

void Newton::predict(const StepProblem& problem, const Buffer<double>& ends, Buffer<double>& x, bool from_rest) {
  const int free_nodes = assembly_.numbering.free_nodes;
  for (int i = 0; i < free_nodes; ++i) {
    Vector3d p = at_node(problem.start, i);
    if (!from_rest) p += problem.dt * at_node(problem.velocity, i);
    at_node(x, i) = p;
  }
  if (contact.surfaces) contact.surfaces->begin(problem.start, ends, x, problem.at_start);
  for (int i = 0; i < free_nodes; ++i) {
    Vector3d p = at_node(x, i);
    const Gap gap = contact.bearing(problem.at_end, p).gap;
    if (gap.distance < 0.0) p -= gap.distance * gap.normal;
    if (contact.surfaces) {
      const std::optional<SmoothTouch> touch = contact.surfaces->touch(i, p);
      if (touch && touch->gap < 0.0) p -= touch->gap * touch->normal;
    }
    at_node(x, i) = p;
  }
}

// Takes x to the prediction, as far as pairs let it, and finds the contacts there.
void Newton::begin(const StepProblem& problem, Buffer<double>& x, bool from_rest, bool smoothly) {
  const int free_nodes = assembly_.numbering.free_nodes;
  contact.hold_reversed = false;
  predict(problem, x, x, from_rest);
  if (pairs) {
    ends_ = x;
    pairs->near.cap(problem.start, x);
  }
  assembly_.set_diagonal(problem.dt, problem.damping);
  correction.factors.of(problem.dt);
  assembly_.evaluate(x, true);
  for (int i = 0; i < free_nodes; ++i) contact.stiffness[i] = law_stiffness_ * assembly_.own_stiffness(i);
  own_stiffness_ = contact.stiffness;
  strained_ = false;
  if (!pairs) return;
  pairs->smoothing = smoothly ? constants_.smoothing_ratio * pairs->near.thickness : 0.0;
  Buffer<double> expected = ends_;
  for (int i = 0; i < free_nodes; ++i) {
    at_node(expected, i) = at_node(problem.start, i) + problem.dt * at_node(problem.velocity, i);
  }
  std::vector<Eigen::Matrix3d> own(free_nodes);
  for (int i = 0; i < free_nodes; ++i) own[i] = assembly_.own_block(i);
  std::vector<Eigen::Matrix3d> turns;
  for (const Bone& bone : pairs->materials.bones) {
    turns.push_back(problem.at_end[bone.body].rotation * problem.at_start[bone.body].rotation.transpose());
  }
  pairs->begin(problem.start, ends_, expected, std::move(own), std::move(turns));
}

// Goes a share of the change from x, as far as pairs let it, to `trial_`. Where they stop nodes, all go less far
// together, down to `common_least`, before any one is stopped by itself.
Norms Newton::move(const StepProblem& problem, const Buffer<double>& x, double share, bool smoothly) {
  const int free_nodes = assembly_.numbering.free_nodes, hops = smoothly ? constants_.smooth_hops : constants_.hops;
  trial_ = x;
  for (int i = 0; i < 4 * free_nodes; ++i) trial_[i] += share * correction.change[i];
  if (pairs) {
    std::copy(ends_.begin() + 4L * free_nodes, ends_.end(), trial_.begin() + 4L * free_nodes);
    wanted_ = trial_;
    if (!pairs->near.cap(x, trial_, hops)) {
      strained_ = true;
      const double common = std::max(pairs->near.common_share(x, wanted_), constants_.common_least);
      if (common < 1.0) {
        for (std::size_t i = 0; i < trial_.size(); ++i) trial_[i] = x[i] + common * (wanted_[i] - x[i]);
        pairs->near.cap(x, trial_, hops);
      }
    }
  }
  assembly_.evaluate(trial_, true);
  return look(problem, trial_, share);
}

// Of the convex matrix and the exact one, takes the exact one near the solution, or where the convex one converges
// slowly, until forces grow.
void Newton::choose_matrix(const Buffer<double>& x, double before, double now, bool whole, bool close) {
  const bool grew = now > before, exact = close || now > constants_.slow * before;
  if (assembly_.definite ? grew || !whole || !exact : !grew) return;
  assembly_.definite = !assembly_.definite;
  assembly_.evaluate(x, true);
}

StepOutcome Newton::solve(const StepProblem& problem, Buffer<double>& x, bool from_rest, int iterations,
                          StepReport& report, bool smoothly) {
  begin(problem, x, from_rest, smoothly);
  Norms norms = look(problem, x);
  if (pairs) pairs->mark_best();
  bool resumed = contact.resume(x, problem.start, residual, problem.at_start, problem.at_end, problem.dt);
  if (pairs && !smoothly) resumed = pairs->resume() || resumed;
  std::vector<double> window(constants_.window, norms.squared);
  const double first = norms.squared;
  trial_ = best_ = x;
  double least = norms.squared, halved = least, last_share = 0.0;
  int strained = 0, halved_at = 0;
  const bool convex = pairs && assembly_.definite;
  for (int iteration = 0; iteration < (pairs ? constants_.longest : 1) * iterations; ++iteration) {
    const bool goes_on = least <= constants_.nearly * first && iteration - halved_at <= constants_.halving_iterations;
    if (iteration >= iterations && !goes_on) break;
    contact.hold_reversed = iteration >= constants_.reversals_from;
    // A step is solved at least once: one that is taken as predicted would creep within the tolerance.
    if (iteration > 0 && !smoothly && norms.largest <= settings_.tolerance && arrived(x)) break;
    if (!std::isfinite(norms.squared)) break;
    strained = strained_ ? strained + 1 : 0;
    if (strained > strained_max && iterations < settings_.newton_max) break;
    ++report.newton;
    strained_ = correction.solve(pairs.get(), x, problem.dt, report);
    // Along the line, non-monotone [Grippo et al. 1986].
    const double limit = *std::max_element(window.begin(), window.end());
    double share = pairs && pairs->smoothing > 0.0 ? reach() : 1.0;
    Norms next;
    for (int cut = 0;; ++cut) {
      next = move(problem, x, share, smoothly);
      if (next.squared <= limit || cut == constants_.cuts_max || (iteration == 0 && resumed)) break;
      share *= 0.5;
    }
    std::swap(x, trial_);
    last_share = share;
    const double before = std::exchange(norms, next).squared;
    if (convex) choose_matrix(x, before, norms.squared, share == 1.0, norms.squared <= constants_.nearly * first);
    if (iteration == 0 && resumed) std::fill(window.begin(), window.end(), norms.squared);
    window[iteration % window.size()] = norms.squared;
    if (pairs && pairs->smoothing > 0.0 && sharpen(problem, x, share, norms)) {
      if (pairs->smoothing == 0.0) break;
      std::fill(window.begin(), window.end(), norms.squared);
      least = halved = std::numeric_limits<double>::infinity();
    }
    if (norms.squared < least) {
      least = norms.squared, best_ = x;
      if (pairs) pairs->mark_best();
    }
    if (least < 0.5 * halved) halved = least, halved_at = iteration;
  }
  if (pairs && pairs->smoothing > 0.0) {
    pairs->smoothing = 0.0;
    norms = look(problem, x, last_share);
  }
  if (!(norms.largest <= settings_.tolerance)) {
    x = best_;
    if (pairs) pairs->return_to_best();
    assembly_.evaluate(x, true);
    norms = look(problem, x);
  }
  return {norms.largest <= settings_.tolerance && arrived(x), norms.largest};
}

// The largest share of the change for which the list of near pairs is complete.
double Newton::reach() const {
  double farthest = 0.0;
  for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
    farthest = std::max(farthest, at_node(correction.change, i).cast<double>().norm());
  }
  return std::min(1.0, constants_.smooth_hops * pairs->near.margin() / farthest);
}

// Once the smoothed law holds nearly: whether the exact one does, or else makes it sharper. Returns whether it did
// either.
bool Newton::sharpen(const StepProblem& problem, const Buffer<double>& x, double share, Norms& norms) {
  if (!(norms.largest <= std::max(constants_.smooth_near * pairs->smoothed_force(), settings_.tolerance))) return false;
  const double smoothing = pairs->smoothing;
  if (norms.largest <= settings_.tolerance && arrived(x)) {
    pairs->smoothing = 0.0;
    norms = look(problem, x, share);
    if (norms.largest <= settings_.tolerance) return true;
  }
  pairs->smoothing = constants_.smoothing_ratio * smoothing;
  norms = look(problem, x, share);
  return true;
}

}  // namespace sim_core
