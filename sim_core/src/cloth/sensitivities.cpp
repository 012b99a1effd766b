#include "cloth/sensitivities.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "cloth/sensitive_contacts.hpp"

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Length of the differences by which gradients are differentiated, m: the error by the third
// derivative of stretching is 1e-7 of the derivative, and 1e-4 at 20 times this length.
constexpr double probe = 5e-7;

}  // namespace

Sensitivities::Sensitivities(Assembly& assembly, Newton& newton, const ClothSettings& settings)
    : assembly_(assembly), newton_(newton), settings_(settings) {}

void Sensitivities::follow(const std::vector<SensitivityParameter>& parameters) {
  parameters_ = parameters;
  const Buffer<double> zero(4L * assembly_.numbering.nodes, 0.0);
  states_.assign(parameters.size(), {zero, zero, zero, zero, zero, zero, {}, 0.0});
  report_ = {};
  for (Buffer<double>* vectors : {&by_term_, &pulled_, &plus_, &minus_, &at_, &at_start_}) {
    *vectors = zero;
  }
  const std::size_t free_nodes = assembly_.numbering.free_nodes;
  nodes_.resize(free_nodes);
  mode_.assign(free_nodes, contact_open);
  const Buffer<float> none(4 * free_nodes, 0.0f);
  for (Buffer<float>* vectors : {&normal_, &direction_, &image_}) *vectors = none;
  for (Buffer<float>* vectors : {&force_, &solution_})
    vectors->assign(solve_group * none.size(), 0.0f);
  unknowns_.assign(parameters.size(), {});
  for (Unknown& unknown : unknowns_) {
    unknown.derivative = unknown.by_parameter = unknown.stiffness_change = zero;
    unknown.correction = none;
  }
  directions_.assign(parameters.empty() ? 0 : directions_max * none.size(), 0.0f);
  images_ = preconditioned_ = directions_;
  triangle_.assign(directions_max * directions_max, 0.0);
  space_ = {0, directions_.data(), images_.data(), preconditioned_.data(), triangle_.data()};
  coupling_.assign(free_nodes, 0.0f);
  turn_stiffness_.assign(free_nodes, 0.0f);
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
  lags_ = assembly_.lags();
  if (!lags_) assembly_.set_lagged_stretch(step.start, 0.0);
  if (assembly_.use_convex_hessian) {
    assembly_.use_convex_hessian = false;
    assembly_.evaluate(step.x, true);
    assembly_.use_convex_hessian = true;
  }
  bodies_ = static_cast<int>(step.at_end.size());
  classify_nodes(step);
  classify_pairs(step);
  ++report_.steps;
  space_.count = 0;
  for (int p = 0; p < count(); p += solve_group) solve(p, std::min(solve_group, count() - p), step);
  assembly_.set_lagged_stretch(step.start, 0.0);
}

// The derivative of R by the parameter itself, with all positions and velocities as they are.
void Sensitivities::by_parameter(int parameter, const Step& step) {
  Buffer<double>& sum = unknowns_[parameter].by_parameter;
  std::fill(sum.begin(), sum.end(), 0.0);
  for (const SensitivityTerm& term : parameters_[parameter]) {
    differentiate_by(term, step);
    // No energy joins two sheets, so the nodes of a sheet have its whole share.
    for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
      if (term.first < 0 || term.first == newton_.contact.sheet[i])
        at_node(sum, i) += term.rate * at_node(by_term_, i);
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
void Sensitivities::predict(const State& state, const DriveRates& rates, const Step& step,
                            Buffer<double>& derivative) const {
  const Numbering& numbering = assembly_.numbering;
  derivative = state.x;
  for (int i = 0; i < numbering.free_nodes; ++i)
    at_node(derivative, i) += step.inertia.dt * at_node(state.before, i);
  for (std::size_t h = 0; h < numbering.held.size(); ++h) {
    auto d = at_node(derivative, numbering.held[h]);
    const Vector3d end = rates.held.rows() > 0 ? Vector3d(rates.held.row(h).transpose())
                                               : Vector3d(Vector3d::Zero());
    d += step.approach * (end - d);
  }
}

// Sets the change of the energies' gradient by d of each parameter.
void Sensitivities::differentiate_gradients(const std::vector<int>& parameters, const Step& step) {
  std::vector<const double*> along;
  std::vector<double*> changes;
  for (int p : parameters) {
    differentiate_stretching(p, step);
    along.push_back(unknowns_[p].derivative.data());
    changes.push_back(unknowns_[p].stiffness_change.data());
  }
  assembly_.add_bending_changes(step.x, along, changes);
}

// Sets the change of stretching's gradient by d, with a start that changes, too, where stretching
// lags behind it.
void Sensitivities::differentiate_stretching(int parameter, const Step& step) {
  const Buffer<double>&derivative = unknowns_[parameter].derivative,
        &of_start = states_[parameter].x;
  Buffer<double>& change = unknowns_[parameter].stiffness_change;
  const double size = std::max(largest_of(derivative), lags_ ? largest_of(of_start) : 0.0);
  std::fill(change.begin(), change.end(), 0.0);
  if (!(size > 0.0)) return;
  const double scale = probe / size;
  const auto gradient_at = [&](double share, Buffer<double>& out) {
    for (std::size_t k = 0; k < at_.size(); ++k) at_[k] = step.x[k] + share * derivative[k];
    if (lags_) {
      for (std::size_t k = 0; k < at_.size(); ++k)
        at_start_[k] = step.start[k] + share * of_start[k];
      assembly_.set_lagged_stretch(at_start_, step.lag);
    }
    assembly_.gradient_of(Assembly::Energy::membrane, at_, out);
  };
  gradient_at(scale, plus_);
  gradient_at(-scale, minus_);
  if (lags_) assembly_.set_lagged_stretch(step.start, step.lag);
  for (std::size_t k = 0; k < change.size(); ++k)
    change[k] = (plus_[k] - minus_[k]) / (2.0 * scale);
}

// Sets the right-hand side to what the equations of all free nodes and pairs lack at d.
void Sensitivities::linearize(int parameter, int place, const Step& step) {
  const State& state = states_[parameter];
  Unknown& unknown = unknowns_[parameter];
  unknown.nearest_event = infinite;
  const DriveRates& rates = rates_of(parameter, step);
  std::fill(pulled_.begin(), pulled_.end(), 0.0);
  linearize_pairs(parameter);
  const Numbering& numbering = assembly_.numbering;
  for (int i = 0; i < numbering.free_nodes; ++i) {
    const double mass = assembly_.mass[i];
    const Vector3d d = at_node(unknown.derivative, i);
    Vector3d gravity = Vector3d::Zero();
    if (rates.gravity.rows() > 0) gravity = rates.gravity.row(numbering.vertex[i]).transpose();
    const Vector3d target = target_of(state, i, gravity, step);
    const double viscous = (step.damping + assembly_.own_damping[i]) / step.inertia.span[i];
    const Vector3d force_change =
        mass * (step.inertia.rate[i] * (d - target) + viscous * (d - origin_of(state, i, step))) +
        at_node(unknown.by_parameter, i) + at_node(unknown.stiffness_change, i) -
        at_node(pulled_, i);
    linearize_node(parameter, place, i, step, force_change);
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

// The rule of Velocities::update, which is linear once it is known what continues.
void Sensitivities::update_history(int parameter, const Step& step) {
  State& state = states_[parameter];
  const Buffer<double>& derivative = unknowns_[parameter].derivative;
  const double dt = step.inertia.dt;
  for (int i = 0; i < assembly_.numbering.nodes; ++i) {
    const Vector3d d = at_node(derivative, i), d0 = at_node(state.x, i);
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
  state.x = derivative;
}

}  // namespace sim_core
