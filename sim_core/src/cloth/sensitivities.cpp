#include "cloth/sensitivities.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Length of the differences by which gradients are differentiated, m: the error by the third
// derivative of stretching is 1e-7 of the derivative, and 1e-4 at 20 times this length.
constexpr double probe = 5e-7;
// Last change of a sensitivity, over its largest value, at which it is refined.
constexpr double refined = 1e-5;
// Rounds of refinement: without pairs a round takes two digits, with pairs that stick less than
// one.
constexpr int rounds_max = 30, rounds_with_pairs_max = 60;
// Relative tolerance of GMRES in a round: less would be lost on the matrix, which is not exact.
// Sweep, in a drag: 3e-3 takes 6 % more rounds and 8 % fewer iterations, 3e-4 the opposite, at the
// same cost; the last round leaves three times as much with the former.
constexpr double round_tolerance = 1e-3;

double largest_of(const Buffer<double>& vectors) {
  double out = 0.0;
  for (double component : vectors) out = std::max(out, std::abs(component));
  return out;
}

}  // namespace

Sensitivities::Sensitivities(Assembly& assembly, Newton& newton, const ClothSettings& settings)
    : assembly_(assembly), newton_(newton), settings_(settings) {}

void Sensitivities::follow(const std::vector<SensitivityParameter>& parameters) {
  parameters_ = parameters;
  const Buffer<double> zero(4L * assembly_.numbering.nodes, 0.0);
  states_.assign(parameters.size(), {zero, zero, zero, zero, zero, zero, {}});
  report_ = {};
  for (Buffer<double>* vectors : {&derivative_, &by_parameter_, &by_term_, &stiffness_change_,
                                  &pulled_, &plus_, &minus_, &at_, &at_start_}) {
    *vectors = zero;
  }
  const std::size_t free_nodes = assembly_.numbering.free_nodes;
  nodes_.resize(free_nodes);
  mode_.assign(free_nodes, contact_open);
  const Buffer<float> none(4 * free_nodes + 64, 0.0f);
  for (Buffer<float>* vectors : {&normal_, &direction_, &force_, &correction_, &solution_, &image_})
    *vectors = none;
  coupling_.assign(free_nodes, 0.0f);
  turn_stiffness_.assign(free_nodes, 0.0f);
  work_.assign((2 * krylov_max + 1) * 4L * free_nodes + 64, 0.0f);
}

void Sensitivities::set_state(int parameter, const Buffer<double>& x, const Buffer<double>& v) {
  State& state = states_[parameter];
  state.x = x;
  state.at_end = state.before = v;
  std::fill(state.continuing.begin(), state.continuing.end(), 0.0);
  state.bodies.clear();
}

// As Velocities::begin does.
void Sensitivities::begin(const Velocities& velocities, const Inertia& inertia) {
  for (State& state : states_) {
    for (int i = 0; i < assembly_.numbering.nodes; ++i) {
      if (inertia.scheme[i] == Scheme::second_order)
        at_node(state.before, i) = at_node(state.at_end, i);
      at_node(state.before, i) += velocities.passed(i) * at_node(state.continuing, i);
    }
  }
}

void Sensitivities::advance(const Step& step) {
  if (empty()) return;
  // Where the step was solved with the matrix of a convex energy, the exact one takes its place:
  // with it refinement converges.
  assembly_.set_lagged_stretch(step.start, step.lag);
  if (assembly_.use_convex_hessian) {
    assembly_.use_convex_hessian = false;
    assembly_.evaluate(step.x, true);
    assembly_.use_convex_hessian = true;
  }
  bodies_ = static_cast<int>(step.at_end.size());
  classify_nodes(step);
  classify_pairs(step);
  ++report_.steps;
  for (int p = 0; p < count(); ++p) solve(p, step);
  assembly_.set_lagged_stretch(step.start, 0.0);
}

// The derivative of R by the parameter itself, with all positions and velocities as they are.
void Sensitivities::by_parameter(int parameter, const Step& step) {
  std::fill(by_parameter_.begin(), by_parameter_.end(), 0.0);
  for (const SensitivityTerm& term : parameters_[parameter]) {
    differentiate_by(term, step);
    // No energy joins two sheets, so the nodes of a sheet have its whole share.
    for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
      if (term.first < 0 || term.first == newton_.contact.sheet[i])
        at_node(by_parameter_, i) += term.rate * at_node(by_term_, i);
    }
  }
}

// Sets `by_term_` to the derivative of R by a number of all sheets.
void Sensitivities::differentiate_by(const SensitivityTerm& term, const Step& step) {
  using Kind = SensitivityTerm::Kind;
  std::fill(by_term_.begin(), by_term_.end(), 0.0);
  switch (term.kind) {
    case Kind::bending:
      assembly_.gradient_of(Assembly::Energy::bending, step.x, by_term_);
      return;
    case Kind::stretching:
      assembly_.gradient_of(Assembly::Energy::membrane, step.x, by_term_);
      return;
    case Kind::bending_warp:
    case Kind::bending_weft:
    case Kind::bending_twist:
    case Kind::softening:
      assembly_.gradient_by(term.bending_number(), step.x, by_term_);
      return;
    case Kind::density: {
      const Inertia& inertia = step.inertia;
      for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
        const double viscous = (step.damping + assembly_.own_damping[i]) / inertia.span[i];
        at_node(by_term_, i) =
            assembly_.mass[i] *
            (inertia.rate[i] * (at_node(step.x, i) - at_node(inertia.target, i)) +
             viscous * (at_node(step.x, i) - at_node(inertia.origin, i)));
      }
      return;
    }
    case Kind::friction_of_body:
    case Kind::friction_of_pair:
    case Kind::static_friction_of_body:
    case Kind::static_friction_of_pair:  // contacts bring these in
      return;
  }
}

const DriveRates& Sensitivities::rates_of(int parameter, const Step& step) const {
  return step.rates.empty() ? no_rates_ : step.rates[parameter];
}

// Where velocities lead, and held nodes at the ends of their ways.
void Sensitivities::predict(const State& state, const DriveRates& rates, const Step& step) {
  const Numbering& numbering = assembly_.numbering;
  derivative_ = state.x;
  for (int i = 0; i < numbering.free_nodes; ++i)
    at_node(derivative_, i) += step.inertia.dt * at_node(state.before, i);
  for (std::size_t h = 0; h < numbering.held.size(); ++h) {
    auto d = at_node(derivative_, numbering.held[h]);
    const Vector3d end = rates.held.rows() > 0 ? Vector3d(rates.held.row(h).transpose())
                                               : Vector3d(Vector3d::Zero());
    d += step.approach * (end - d);
  }
}

// Sets `stiffness_change_` to the change of the energies' gradient by d, with a start that changes,
// too, where stretching lags behind it.
void Sensitivities::differentiate_gradient(const State& state, const Step& step) {
  const double size = std::max(largest_of(derivative_), step.lag > 0.0 ? largest_of(state.x) : 0.0);
  std::fill(stiffness_change_.begin(), stiffness_change_.end(), 0.0);
  if (!(size > 0.0)) return;
  const double scale = probe / size;
  const auto gradient_at = [&](double share, Buffer<double>& out) {
    for (std::size_t k = 0; k < at_.size(); ++k) at_[k] = step.x[k] + share * derivative_[k];
    if (step.lag > 0.0) {
      for (std::size_t k = 0; k < at_.size(); ++k)
        at_start_[k] = step.start[k] + share * state.x[k];
      assembly_.set_lagged_stretch(at_start_, step.lag);
    }
    assembly_.gradient_of(Assembly::Energy::all, at_, out);
  };
  gradient_at(scale, plus_);
  gradient_at(-scale, minus_);
  if (step.lag > 0.0) assembly_.set_lagged_stretch(step.start, step.lag);
  for (std::size_t k = 0; k < stiffness_change_.size(); ++k)
    stiffness_change_[k] = (plus_[k] - minus_[k]) / (2.0 * scale);
}

// Sets the right-hand side to what the equations of all free nodes and pairs lack at d.
void Sensitivities::linearize(int parameter, const Step& step) {
  const State& state = states_[parameter];
  const DriveRates& rates = rates_of(parameter, step);
  std::fill(pulled_.begin(), pulled_.end(), 0.0);
  linearize_pairs(parameter);
  differentiate_gradient(state, step);
  const Numbering& numbering = assembly_.numbering;
  for (int i = 0; i < numbering.free_nodes; ++i) {
    const double mass = assembly_.mass[i];
    const Vector3d d = at_node(derivative_, i);
    Vector3d gravity = Vector3d::Zero();
    if (rates.gravity.rows() > 0) gravity = rates.gravity.row(numbering.vertex[i]).transpose();
    const Vector3d target = target_of(state, i, gravity, step);
    const double viscous = (step.damping + assembly_.own_damping[i]) / step.inertia.span[i];
    const Vector3d force_change =
        mass * (step.inertia.rate[i] * (d - target) + viscous * (d - origin_of(state, i, step))) +
        at_node(by_parameter_, i) + at_node(stiffness_change_, i) - at_node(pulled_, i);
    linearize_node(parameter, i, step, force_change);
  }
}

// As Velocities::set_inertia, which is linear in what it starts from.
Vector3d Sensitivities::origin_of(const State& state, int node, const Step& step) const {
  const Vector3d d0 = at_node(state.x, node);
  if (step.inertia.scheme[node] != Scheme::second_order) return d0;
  return step.velocities.a1() * d0 + step.velocities.a2() * at_node(state.x_before, node);
}

Vector3d Sensitivities::target_of(const State& state, int node, const Vector3d& gravity,
                                  const Step& step) const {
  const Vector3d by_gravity = gravity / step.inertia.rate[node];
  const Vector3d v = at_node(state.before, node);
  if (step.inertia.scheme[node] != Scheme::second_order)
    return at_node(state.x, node) + step.inertia.dt * v + by_gravity;
  const Vector3d momentum =
      step.velocities.a1() * v + step.velocities.a2() * at_node(state.v_before, node);
  return origin_of(state, node, step) + step.inertia.span[node] * momentum + by_gravity;
}

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

// What contact prescribes, `correction_`, goes to the right-hand side, and the forces of pairs.
void Sensitivities::subtract_corrections(const ClothMatrix& matrix) {
  const int free_nodes = assembly_.numbering.free_nodes;
  assembly_.kernel.apply(matrix, correction_.data(), image_.data());
  for (const PairContact& contact : pairs_) {
    for (int c = 0; c < 4; ++c) {
      const int node = contact.pair->stencil.node[c];
      if (node >= free_nodes) continue;
      at_node(image_, node) -= (contact.pair->weights[c] * contact.right_side).cast<float>();
    }
  }
  for (int i = 0; i < free_nodes; ++i) {
    if (mode_[i] == contact_stick) continue;
    auto force = at_node(force_, i), pulled = at_node(image_, i);
    if (mode_[i] == contact_open) {
      force -= pulled;
      continue;
    }
    const auto n = at_node(normal_, i), t = at_node(direction_, i);
    const float normal_force = n.dot(pulled);
    force -= pulled - normal_force * n - coupling_[i] * normal_force * t;
  }
}

// Solves for the update that the right-hand side asks for, and takes the best mix of it and those
// before. Returns its size over that of d.
double Sensitivities::refine(const Step& step) {
  const int components = 4 * assembly_.numbering.free_nodes;
  const Factor& factor = factor_for(step);
  PairData pair_data = pair_arrays_.data();
  ClothMatrix matrix = assembly_.matrix;
  matrix.pairs = pairs_.empty() ? nullptr : &pair_data;
  subtract_corrections(matrix);
  std::fill(solution_.begin(), solution_.end(), 0.0f);
  const ContactRows rows{mode_.data(), normal_.data(), direction_.data(), coupling_.data(),
                         turn_stiffness_.data()};
  report_.krylov += assembly_.kernel.krylov(matrix, factor, rows, force_.data(), solution_.data(),
                                            work_.data(), round_tolerance);
  double change = 0.0, size = 0.0;
  for (int k = 0; k < components; ++k) {
    solution_[k] += correction_[k];
    change = std::max(change, std::abs(static_cast<double>(solution_[k])));
  }
  find_pair_updates();
  take_update();
  for (int k = 0; k < components; ++k) size = std::max(size, std::abs(derivative_[k]));
  return size > 0.0 ? change / size : 0.0;
}

void Sensitivities::solve(int parameter, const Step& step) {
  State& state = states_[parameter];
  by_parameter(parameter, step);
  predict(state, rates_of(parameter, step), step);
  for (PairContact& contact : pairs_) contact.change.setZero();
  const int rounds = pairs_.empty() ? rounds_max : rounds_with_pairs_max;
  double change = 0.0;
  acceleration_.restart();
  for (int round = 0; round < rounds; ++round) {
    linearize(parameter, step);
    change = refine(step);
    ++report_.rounds;
    if (!(change > refined)) break;
  }
  report_.change = std::max(report_.change, change);
  report_.unrefined += change > refined;
  state.nearest_event = nearest_event_of_contacts();
  update_history(state, step);
  // Bodies are at the rates of the step's end once all of it is taken.
  if (step.end == 1.0) state.bodies = rates_of(parameter, step).bodies;
}

// The rule of Velocities::update, which is linear once it is known what continues.
void Sensitivities::update_history(State& state, const Step& step) {
  const double dt = step.inertia.dt;
  for (int i = 0; i < assembly_.numbering.nodes; ++i) {
    const Vector3d d = at_node(derivative_, i), d0 = at_node(state.x, i);
    const Vector3d before = at_node(state.before, i);
    const Vector3d origin = origin_of(state, i, step);
    at_node(state.v_before, i) = at_node(state.at_end, i);
    at_node(state.x_before, i) = d0;
    if (step.inertia.scheme[i] == Scheme::second_order) {
      const Vector3d at_end = (d - origin) / step.inertia.span[i];
      at_node(state.continuing, i) = (at_end - before) / dt;
      at_node(state.at_end, i) = at_node(state.before, i) = at_end;
      continue;
    }
    const Vector3d middle = (d - d0) / dt;
    // rate = 1/(dt b)
    const Vector3d acceleration = dt * step.inertia.rate[i] * (middle - before);
    const bool goes_on = step.velocities.continued(i);
    at_node(state.continuing, i) = goes_on ? acceleration : Vector3d(Vector3d::Zero());
    at_node(state.at_end, i) = goes_on ? Vector3d(middle + 0.5 * dt * acceleration) : middle;
    at_node(state.before, i) = middle;
  }
  state.x = derivative_;
}

}  // namespace sim_core
