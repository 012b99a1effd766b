#include "cloth/newton.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "math/stopwatch.hpp"

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Contact stiffness of the law over a node's own.
constexpr double contact_share = 0.1;
// Iterations after which a contact that turns back is held.
constexpr int reversals_from = 4;
// With pairs: rounds of making pairs bear in an iteration, and the tolerance of GMRES, which predicts their gaps.
constexpr int rounds_max = 6;
constexpr double pairs_tolerance = 1e-4;
// The smoothed law begins with this share of the thickness, and gets sharper by this factor once forces miss it by no
// more than so many times those that it smooths over. GMRES then solves to this tolerance, and no node goes further in
// an iteration than so many margins of what is known to be near.
constexpr double smooth_from = 0.1, smooth_less = 0.1, smooth_near = 5.0;
constexpr double smooth_tolerance = 1e-6, smooth_reach = 4.0;
// Where the matrix of a convex energy brings the squares of forces down by less than this factor in a whole
// correction, the exact one takes its place until they grow.
constexpr double slow = 0.25;
// An attempt with pairs that has brought the squares of forces down by so much goes on while it halves them in so many
// iterations, up to so many times as long.
constexpr double nearly = 1e-4;
constexpr int halving_iterations = 15, longest = 4;
// An attempt by way of the smoothed law is given up where the squares of forces have grown by so much.
constexpr double diverged = 1e8;
// A gap or a slip of a pair that counts as much as the tolerance does, m.
constexpr double length_tolerance = 2e-9;
// Nodes that are stopped one by one strain the cloth: so all go less far together, down to this share, before any one
// is stopped by itself.
constexpr double common_least = 0.1;
// A correction that leads further than so many hops of its search for pairs is no guide.
constexpr int hops_max = 1, smooth_hops_max = 4;

}  // namespace

Newton::Newton(Assembly& assembly, const ClothSettings& settings)
    : contact(assembly.numbering.free_nodes),
      factors(assembly.numbering),
      residual(4L * assembly.numbering.nodes, 0.0),
      assembly_(assembly),
      settings_(settings),
      trial_(residual),
      best_(residual),
      change_(4L * assembly.numbering.free_nodes + 64, 0.0f),
      work_((2 * krylov_max + 1) * 4L * assembly.numbering.free_nodes + 64, 0.0f),
      image_(change_) {}

void Newton::evaluate(const Buffer<double>& x, bool with_matrix) {
  const Stopwatch watch(phases.assembly);
  assembly_.evaluate(x, with_matrix);
}

// R = M ((x - x_inertial)/dt^2 + c (x - x_start)/dt) + grad E, and the branch of each contact's law.
Norms Newton::look(const StepProblem& problem, const Buffer<double>& x, double share) {
  const Stopwatch watch(phases.contact);
  const double inertia = 1.0 / (problem.dt * problem.dt);
  for (int i = 0; i < assembly_.numbering.nodes; ++i) {
    const double viscous = (problem.damping + assembly_.own_damping[i]) / problem.dt;
    at_node(residual, i) = assembly_.mass[i] * (inertia * (at_node(x, i) - at_node(problem.inertial, i)) +
                                                viscous * (at_node(x, i) - at_node(problem.start, i))) +
                           at_node(assembly_.gradient, i);
  }
  if (pairs) pairs->look(x, share, residual);
  if (contact.surfaces) {  // those that push cloth together hold it as stiffly as pairs do
    contact.stiffness = own_stiffness_;
    pairs->add_stiffness(contact_share, contact.stiffness);
  }
  Norms norms = contact.sort(x, problem.start, residual, problem.at_start, problem.at_end);
  if (pairs) pairs->count_errors(settings_.tolerance / length_tolerance, norms);
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
  if (contact.surfaces) contact.surfaces->begin(problem.start, ends, x);
  for (int i = 0; i < free_nodes; ++i) {
    Vector3d p = at_node(x, i);
    for (const Body& body : problem.at_end) {
      const Gap gap = gap_of(body, p);
      if (gap.distance < 0.0) p -= gap.distance * gap.normal;
    }
    if (contact.surfaces) {
      const std::optional<SmoothTouch> touch = contact.surfaces->touch(i, p);
      if (touch && touch->gap < 0.0) p -= touch->gap * touch->normal;
    }
    at_node(x, i) = p;
  }
}

StepOutcome Newton::solve(const StepProblem& problem, Buffer<double>& x, bool from_rest, int iterations,
                          StepReport& report, double krylov_tolerance, bool smoothly) {
  const int free_nodes = assembly_.numbering.free_nodes;
  contact.hold_reversed = false;
  predict(problem, x, x, from_rest);
  if (pairs) {
    const Stopwatch watch(phases.contact);
    ends_ = x;
    pairs->near.cap(problem.start, x);
  }
  assembly_.set_diagonal(problem.dt, problem.damping);
  factors.of(problem.dt);
  evaluate(x, true);
  for (int i = 0; i < free_nodes; ++i) contact.stiffness[i] = contact_share * assembly_.own_stiffness(i);
  own_stiffness_ = contact.stiffness;
  if (pairs) {
    pairs->smoothing = smoothly ? smooth_from * pairs->near.thickness : 0.0;
    Buffer<double> expected = ends_;
    for (int i = 0; i < free_nodes; ++i) {
      at_node(expected, i) = at_node(problem.start, i) + problem.dt * at_node(problem.velocity, i);
    }
    std::vector<Eigen::Matrix3d> own(free_nodes);
    for (int i = 0; i < free_nodes; ++i) own[i] = assembly_.own_block(i);
    pairs->begin(problem.start, ends_, expected, std::move(own));
  }
  Norms norms = look(problem, x);
  if (pairs) pairs->mark_best();
  bool resumed = contact.resume(x, problem.start, residual, problem.at_start, problem.at_end, problem.dt);
  if (pairs && !smoothly) resumed = pairs->resume() || resumed;
  std::vector<int> modes = contact.mode;
  double window[4];
  std::fill(window, window + 4, norms.squared);
  const double first = norms.squared;
  trial_ = best_ = x;
  double least = norms.squared, halved = least;
  int strained = 0, halved_at = 0;
  const bool convex = pairs && assembly_.definite;
  const int hops = smoothly ? smooth_hops_max : hops_max;
  double last_share = 0.0;
  strained_ = false;
  for (int iteration = 0; iteration < (pairs ? longest : 1) * iterations; ++iteration) {
    const bool goes_on = least <= nearly * first && iteration - halved_at <= halving_iterations;
    if (iteration >= iterations && !goes_on) break;
    contact.hold_reversed = iteration >= reversals_from;
    // A step is solved at least once: one that is taken as predicted would creep within the tolerance.
    if (iteration > 0 && !smoothly && norms.largest <= settings_.tolerance && arrived(x)) break;
    if (!std::isfinite(norms.squared)) break;
    if (smoothly && norms.squared > diverged * first) break;
    strained = strained_ ? strained + 1 : 0;
    if (strained > strained_max && iterations < settings_.newton_max) break;
    ++report.newton;
    correct(problem, x, krylov_tolerance, report);
    // Along the line, non-monotone [Grippo et al. 1986].
    const double limit = *std::max_element(window, window + 4);
    double share = pairs && pairs->smoothing > 0.0 ? reach() : 1.0;
    Norms next;
    for (int cut = 0;; ++cut) {
      trial_ = x;
      for (int i = 0; i < 4 * free_nodes; ++i) trial_[i] += share * change_[i];
      if (pairs) {
        const Stopwatch watch(phases.contact);
        std::copy(ends_.begin() + 4L * free_nodes, ends_.end(), trial_.begin() + 4L * free_nodes);
        wanted_ = trial_;
        if (!pairs->near.cap(x, trial_, hops)) {
          strained_ = true;
          const double common = std::max(pairs->near.common_share(x, wanted_), common_least);
          if (common < 1.0) {
            for (std::size_t i = 0; i < trial_.size(); ++i) trial_[i] = x[i] + common * (wanted_[i] - x[i]);
            pairs->near.cap(x, trial_, hops);
          }
        }
      }
      evaluate(trial_, true);
      next = look(problem, trial_, share);
      if (next.squared <= limit * (cut < 4 ? 1.0 : 1e4) || cut == 5 || (iteration == 0 && resumed)) break;
      share *= 0.5;
    }
    for (int i = 0; i < free_nodes; ++i) report.flips += contact.mode[i] != modes[i];
    modes = contact.mode;
    std::swap(x, trial_);
    last_share = share;
    const double before = norms.squared;
    norms = next;
    if (convex) {
      const bool grew = norms.squared > before;
      if (assembly_.definite ? !grew && share == 1.0 && norms.squared > slow * before : grew) {
        assembly_.definite = !assembly_.definite;
        evaluate(x, true);
      }
    }
    if (iteration == 0 && resumed) std::fill(window, window + 4, norms.squared);
    window[iteration % 4] = norms.squared;
    if (pairs && pairs->smoothing > 0.0 && sharpen(problem, x, share, norms)) {
      if (pairs->smoothing == 0.0) break;
      std::fill(window, window + 4, norms.squared);
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
    evaluate(x, true);
    norms = look(problem, x);
  }
  return {norms.largest <= settings_.tolerance && arrived(x), norms.largest};
}

// The share of the change that takes no node further than is known of what is near.
double Newton::reach() const {
  double farthest = 0.0;
  for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
    farthest = std::max(farthest, at_node(change_, i).cast<double>().norm());
  }
  return std::min(1.0, smooth_reach * pairs->near.margin() / farthest);
}

// Once the smoothed law holds nearly: whether the exact one does, or else makes it sharper. Returns whether it did
// either.
bool Newton::sharpen(const StepProblem& problem, const Buffer<double>& x, double share, Norms& norms) {
  if (!(norms.largest <= std::max(smooth_near * pairs->smoothed_force(), settings_.tolerance))) return false;
  const double smoothing = pairs->smoothing;
  if (norms.largest <= settings_.tolerance && arrived(x)) {
    pairs->smoothing = 0.0;
    norms = look(problem, x, share);
    if (norms.largest <= settings_.tolerance) return true;
  }
  pairs->smoothing = smooth_less * smoothing;
  norms = look(problem, x, share);
  return true;
}

// Solves J change = -F to the tolerance of GMRES, in the directions that contact leaves free; it prescribes the others.
void Newton::correct(const StepProblem& problem, const Buffer<double>& x, double krylov_tolerance, StepReport& report) {
  if (pairs) force_ = contact.force;
  if (!pairs || !pairs->active()) {
    StaleFactor& factor = factors.latest();
    {
      const Stopwatch watch(phases.factorization);
      report.factorizations += factor.renew(assembly_, x, contact, problem.dt, settings_);
    }
    const KrylovResult solved = solve_linear(factor.view(), krylov_tolerance);
    factor.spent(solved.iterations);
    report.krylov += solved.iterations;
  } else {
    correct_with_pairs(problem, x, report);
  }
  if (!pairs) return;
  int round = 0;
  if (pairs->smoothing == 0.0) {
    for (; round < rounds_max && pairs->activate(change_); ++round) correct_with_pairs(problem, x, report);
  }
  strained_ = round == rounds_max;
  pairs->solved(change_);
}

void Newton::correct_with_pairs(const StepProblem& problem, const Buffer<double>& x, StepReport& report) {
  {
    const Stopwatch watch(phases.factorization);
    report.factorizations += pair_factor_.renew(assembly_, x, contact, *pairs, problem.dt, settings_);
  }
  contact.force = force_;
  pair_rows_ = pairs->rows();
  assembly_.matrix.pairs = &pair_rows_;
  const KrylovResult solved =
      solve_linear(pair_factor_.view(),
                   pairs->smoothing > 0.0 ? smooth_tolerance : std::min(settings_.krylov_tolerance, pairs_tolerance));
  assembly_.matrix.pairs = nullptr;
  pair_factor_.spent(solved.iterations);
  report.krylov += solved.iterations;
}

KrylovResult Newton::solve_linear(const Factor& factor, double krylov_tolerance) {
  const Stopwatch watch(phases.krylov);
  subtract_corrections();
  double size = 0.0;
  for (float f : contact.force) size += static_cast<double>(f) * f;
  size = std::sqrt(size);
  const double tolerance = std::max(krylov_tolerance, 0.3 * settings_.tolerance / std::max(size, 1e-300));
  const KrylovResult solved =
      assembly_.kernel.krylov(assembly_.matrix, factor, contact.rows(), contact.force.data(), change_.data(),
                              work_.data(), settings_.krylov_max, std::min(tolerance, 0.5));
  for (int i = 0; i < 4 * assembly_.numbering.free_nodes; ++i) change_[i] += contact.correction[i];
  return solved;
}

// What contact prescribes, `correction`, goes to the right-hand side, and what pairs' forces do of themselves.
void Newton::subtract_corrections() {
  const Buffer<float>& correction = contact.correction;
  const bool with_pairs = assembly_.matrix.pairs != nullptr;
  if (!with_pairs && std::all_of(correction.begin(), correction.end(), [](float c) { return c == 0.0f; })) return;
  assembly_.kernel.apply(assembly_.matrix, correction.data(), image_.data());
  if (with_pairs) pairs->subtract_right_side(image_);
  for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
    if (contact.mode[i] == contact_stick) continue;
    auto force = at_node(contact.force, i), pulled = at_node(image_, i);
    if (contact.mode[i] == contact_open) {
      force -= pulled;
      continue;
    }
    const auto n = at_node(contact.normal, i), t = at_node(contact.direction, i);
    const float pressing = n.dot(pulled);
    force -= pulled - pressing * n - contact.mu[i] * pressing * t;
  }
}

}  // namespace sim_core
