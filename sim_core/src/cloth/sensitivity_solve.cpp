// How the equations of the sensitivities are solved: rounds of refinement, each for several
// parameters at once.
#include <algorithm>
#include <cmath>

#include "cloth/sensitive_contacts.hpp"

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Expected change of a sensitivity by one more round, over its largest value, at which it is
// refined: the errors of steps add up. With 1e-6 cloth on a rod that turns is 7e-6 off, with 5e-7
// 1e-7.
constexpr double refined = 5e-7;
// The same from which a step counts as not refined, and with pairs.
constexpr double unrefined = 1e-5;
// Rounds of refinement: without pairs a round takes two digits, with pairs that stick less than
// one.
constexpr int rounds_max = 30, rounds_with_pairs_max = 60;
// What a round leaves unsolved, over what it was expected to change: less would be lost on the
// matrix, which is not exact. In a drag of mesh 21, 1e-3 takes 6 % more directions and 4 % fewer
// rounds, 1e-2 2 % fewer and 14 % more.
constexpr double round_tolerance = 3e-3;
// The same with pairs, by GMRES.
constexpr double round_with_pairs_tolerance = 1e-3;
// The same without pairs, over the largest derivative, where the matrix is exact: with 1e-9 a sheet
// on an incline is eight times as far off, and a drag takes as many directions.
constexpr double solve_tolerance = 1e-10;
// Share of its change that a round leaves at least because the matrix is not exact, and how many
// times the share of the round before: what one round leaves lies where the matrix is least exact.
// In a drag of mesh 21 the second round leaves 0.006 in the median, and the first one 0.001.
constexpr double inexact_share = 0.01, inexact_growth = 5.0;
// Directions that a round may need: those of others make room for so many.
constexpr int directions_of_round = 32;

// Share of its change that a round leaves. `expected`: that change, as the round before left it;
// `change_before`: of the round before, 0 if there was none.
double share_left(double expected, double change_before) {
  if (!(change_before > 0.0)) return 1.0;
  return std::clamp(inexact_growth * expected / change_before, inexact_share, 1.0);
}

}  // namespace

// The factor that Newton's method has for steps of this length, or a spare one.
const Factor& Sensitivities::factor_for(const Step& step) {
  const bool with_pairs = !pairs_.empty();
  if (const Factor* factor =
          newton_.linear_solver.factor_at_hand(step.inertia.factor_step, with_pairs))
    return *factor;
  if (with_pairs) {
    if (!spare_pair_factor_) spare_pair_factor_ = std::make_unique<PairFactor>();
    spare_pair_factor_->renew(assembly_, step.x, newton_.contact, *newton_.pairs,
                              step.inertia.factor_step, settings_);
    return spare_pair_factor_->view();
  }
  if (!spare_factor_) spare_factor_ = std::make_unique<StaleFactor>(assembly_.numbering);
  spare_factor_->renew(assembly_, step.x, newton_.contact, step.inertia.factor_step, settings_);
  return spare_factor_->view();
}

// What contact prescribes goes to the right-hand side, and the forces of pairs.
void Sensitivities::subtract_corrections(const ClothMatrix& matrix, const Unknown& unknown,
                                         int place) {
  const int free_nodes = assembly_.numbering.free_nodes;
  assembly_.kernel.apply(matrix, unknown.correction.data(), image_.data());
  for (std::size_t k = 0; k < pairs_.size(); ++k) {
    const Pair& pair = *pairs_[k].pair;
    for (int c = 0; c < 4; ++c) {
      const int node = pair.stencil.node[c];
      if (node >= free_nodes) continue;
      at_node(image_, node) -= (pair.weights[c] * unknown.pairs[k].right_side).cast<float>();
    }
  }
  for (int i = 0; i < free_nodes; ++i) {
    if (mode_[i] == contact_stick) continue;
    auto force = at_node(force_, place * free_nodes + i), pulled = at_node(image_, i);
    if (mode_[i] == contact_open) {
      force -= pulled;
      continue;
    }
    const auto n = at_node(normal_, i), t = at_node(direction_, i);
    const float normal_force = n.dot(pulled);
    force -= pulled - normal_force * n - coupling_[i] * normal_force * t;
  }
}

// Solves for the updates that the right-hand sides ask for, and takes the best mix of them and
// those before.
void Sensitivities::refine(const std::vector<int>& parameters, const Step& step) {
  const int components = 4 * assembly_.numbering.free_nodes,
            count = static_cast<int>(parameters.size());
  const Factor& factor = factor_for(step);
  PairData pair_data = pair_arrays_.data();
  ClothMatrix matrix = assembly_.matrix;
  matrix.pairs = pairs_.empty() ? nullptr : &pair_data;
  const ContactRows rows{mode_.data(), normal_.data(), direction_.data(), coupling_.data(),
                         turn_stiffness_.data()};
  double targets[solve_group], expected[solve_group];
  for (int place = 0; place < count; ++place) {
    Unknown& unknown = unknowns_[parameters[place]];
    subtract_corrections(matrix, unknown, place);
    targets[place] = solve_tolerance * largest_of(unknown.derivative);
    expected[place] = 0.0;
  }
  if (pairs_.empty()) {
    if (space_.count + directions_of_round > directions_max) space_.count = 0;
    report_.krylov +=
        assembly_.kernel.recycle(matrix, factor, rows, space_, count, force_.data(),
                                 solution_.data(), round_tolerance, targets, expected);
  } else {
    // With pairs the matrix is too far from the factor's for directions to serve again.
    std::fill(solution_.begin(), solution_.end(), 0.0f);
    for (long at = 0; at < 1L * count * components; at += components) {
      report_.krylov += assembly_.kernel.krylov(matrix, factor, rows, &force_[at], &solution_[at],
                                                directions_.data(), round_with_pairs_tolerance);
    }
  }
  for (int place = 0; place < count; ++place) {
    Unknown& unknown = unknowns_[parameters[place]];
    const double change_before = unknown.change;
    unknown.change = 0.0;
    double prescribed = 0.0;
    float* solution = &solution_[1L * place * components];
    for (int k = 0; k < components; ++k) {
      solution[k] += unknown.correction[k];
      prescribed = std::max(prescribed, std::abs(static_cast<double>(unknown.correction[k])));
      unknown.change = std::max(unknown.change, std::abs(static_cast<double>(solution[k])));
    }
    find_pair_updates(unknown, place);
    take_update(unknown, place);
    unknown.size = largest_of(unknown.derivative);
    const double left = std::max(targets[place], round_tolerance * expected[place]);
    const double to_change = std::max(expected[place], prescribed);
    unknown.expected = pairs_.empty()
                           ? std::max(left, share_left(to_change, change_before) * unknown.change)
                           : unknown.change;
  }
}

void Sensitivities::begin_solve(int parameter, const Step& step) {
  Unknown& unknown = unknowns_[parameter];
  by_parameter(parameter, step);
  predict(states_[parameter], rates_of(parameter, step), step, unknown.derivative);
  unknown.pairs.assign(pairs_.size(), {});
  unknown.acceleration.restart();
  unknown.size = unknown.change = unknown.expected = 0.0;
}

void Sensitivities::solve(int first, int count, const Step& step) {
  std::vector<int> parameters;
  for (int p = first; p < first + count; ++p) {
    begin_solve(p, step);
    parameters.push_back(p);
  }
  const int rounds = pairs_.empty() ? rounds_max : rounds_with_pairs_max;
  const double allowed = pairs_.empty() ? refined : unrefined;
  for (int round = 0; round < rounds; ++round) {
    differentiate_gradients(parameters, step);
    for (std::size_t place = 0; place < parameters.size(); ++place)
      linearize(parameters[place], static_cast<int>(place), step);
    refine(parameters, step);
    report_.rounds += static_cast<long>(parameters.size());
    parameters.erase(
        std::remove_if(parameters.begin(), parameters.end(),
                       [&](int p) { return unknowns_[p].expected <= allowed * unknowns_[p].size; }),
        parameters.end());
    if (parameters.empty()) break;
  }
  for (int p = first; p < first + count; ++p) {
    const Unknown& unknown = unknowns_[p];
    State& state = states_[p];
    const double change = unknown.size > 0.0 ? unknown.expected / unknown.size : 0.0;
    report_.change = std::max(report_.change, change);
    report_.unrefined += change > unrefined;
    state.nearest_event = unknown.nearest_event;
    update_history(p, step);
    // Bodies are at the rates of the step's end once all of it is taken.
    if (step.end == 1.0) state.bodies = rates_of(p, step).bodies;
  }
}

}  // namespace sim_core
