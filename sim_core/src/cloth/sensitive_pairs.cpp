// How pairs of closest points enter the sensitivities.
#include <algorithm>

#include "cloth/sensitive_contacts.hpp"

namespace sim_core {

using Eigen::Vector3d;

// The pairs that bear a force, and what of them does not depend on the parameter. Weights are
// stationary for distances, not for slips. How much rho turns in the step is taken for a constant.
void Sensitivities::classify_pairs(const Step& step) {
  pairs_.clear();
  pair_arrays_.clear();
  if (!newton_.pairs) return;
  ContactSet& pairs = *newton_.pairs;
  for (const Pair& pair : pairs.list()) {
    if (!pair.active() || pair.contact.force.isZero(0.0)) continue;
    PairContact contact;
    contact.pair = &pair;
    contact.turn = pairs.turn_of(pair.stencil, pair.weights);
    const FourPoints now = points_of(pair.stencil, step.x),
                     before = points_of(pair.stencil, step.start);
    contact.along_now << between_closest(pair.along_first, now),
        between_closest(pair.along_second, now);
    contact.along_start << between_closest(pair.along_first, before),
        between_closest(pair.along_second, before);
    contact.way =
        between_closest(pair.weights, now) - contact.turn * between_closest(pair.weights, before);
    contact.distance = pair.contact.gap + pair.thickness;
    const Contact& at = pair.contact;
    if (pair.row.mode == contact_slip) {
      const Vector3d slip = in_plane(contact.way, at.normal);
      const Vector3d asked = at.friction() - at.stiffness * slip;
      const double bound = at.mu * std::max(at.normal_force(), 0.0);
      contact.direction =
          asked.norm() > 0.0 ? Vector3d(asked.normalized()) : Vector3d(at.normal.unitOrthogonal());
      contact.turn_stiffness = turn_stiffness_of(bound, slip.norm(), at.stiffness);
      contact.softening = 1.0 / (1.0 + contact.turn_stiffness / pair.proximal.tangential);
    }
    pairs_.push_back(contact);
    pair_arrays_.add(pair, assembly_.numbering.free_nodes);
  }
}

PairMotions Sensitivities::motions_of(const Pair& pair, const Buffer<double>& vectors) {
  PairMotions out = PairMotions::Zero();
  for (int c = 0; c < 4; ++c) {
    const Vector3d d = at_node(vectors, pair.stencil.node[c]);
    out.segment<3>(0) += pair.weights[c] * d;
    out.segment<3>(3) += pair.along_first[c] * d;
    out.segment<3>(6) += pair.along_second[c] * d;
  }
  return out;
}

// How much the coefficient of a pair changes by the parameter.
double Sensitivities::friction_rate(int parameter, const Pair& pair) const {
  const std::vector<int>& sheet_of_node = newton_.pairs->near.surface.sheet_of_node;
  const auto [low, high] =
      std::minmax(sheet_of_node[pair.stencil.node[0]], sheet_of_node[pair.stencil.node[3]]);
  double rate = 0.0;
  for (const SensitivityTerm& by : parameters_[parameter]) {
    const bool is_of_pair = by.is_friction_of_pair() && by.is_of(pair.cone.value_or(Cone::sliding));
    if (is_of_pair && low == by.first && high == by.second) rate += by.rate;
  }
  return rate;
}

// Sets the right-hand sides of pairs to what their laws lack at d, and `pulled_` to the change of
// their pull on nodes.
void Sensitivities::linearize_pairs(int parameter) {
  const State& state = states_[parameter];
  Unknown& unknown = unknowns_[parameter];
  const auto expect_event = [&](double change) {
    unknown.nearest_event = std::min(unknown.nearest_event, change);
  };
  for (std::size_t k = 0; k < pairs_.size(); ++k) {
    const PairContact& contact = pairs_[k];
    PairChange& by = unknown.pairs[k];
    const Pair& pair = *contact.pair;
    const Contact& at = pair.contact;
    const Vector3d &n = at.normal, &r = at.force;
    const PairMotions motions = motions_of(pair, unknown.derivative);
    const Vector3d start = motions_of(pair, state.x).head<3>();
    const Eigen::Vector2d places = pair.sliding * motions;
    const Vector3d m = motions.head<3>(), rho_change = m + contact.along_now * places;
    const Vector3d dn = in_plane(rho_change, n) / contact.distance;
    const Vector3d way_change = rho_change - contact.turn * (start + contact.along_start * places);
    const Vector3d slip_change = in_plane(way_change, n) - contact.way.dot(n) * dn;
    const double opening = m.dot(n), kappa = pair.proximal.normal;
    const double pressing = r.dot(n), normal_change = by.change.dot(n) + r.dot(dn);
    const Vector3d friction_change = in_plane(by.change - normal_change * n - pressing * dn, n);
    const double own_rate = friction_rate(parameter, pair);
    expect_event(event_at(pressing, normal_change));
    if (pair.row.mode == contact_stick) {
      by.right_side = -kappa * opening * n - pair.proximal.tangential * slip_change;
      const Vector3d friction = at.friction();
      const double size = friction.norm();
      const double margin_rate =
          own_rate * pressing + at.mu * normal_change -
          (size > 0.0 ? friction.dot(friction_change) / size : friction_change.norm());
      expect_event(event_at(at.mu * pressing - size, margin_rate));
    } else {
      const Vector3d& t = contact.direction;
      Vector3d lacking = friction_change;
      lacking -= (at.mu * normal_change + own_rate * std::max(pressing, 0.0)) * t;
      lacking += contact.turn_stiffness * (slip_change - slip_change.dot(t) * t);
      const double along = lacking.dot(t);
      by.right_side = -kappa * opening * n - (along + at.mu * kappa * opening) * t -
                      contact.softening * (lacking - along * t);
      expect_event(event_at(in_plane(contact.way, n).norm(), slip_change.dot(t)));
    }
    for (int c = 0; c < 4; ++c) {
      at_node(pulled_, pair.stencil.node[c]) +=
          pair.weights[c] * by.change +
          (pair.along_first[c] * places[0] + pair.along_second[c] * places[1]) * r;
    }
  }
}

// Finds how the solution of a round updates the changes of the pairs' forces.
void Sensitivities::find_pair_updates(Unknown& unknown, int place) {
  const int free_nodes = assembly_.numbering.free_nodes;
  for (std::size_t k = 0; k < pairs_.size(); ++k) {
    const Pair& pair = *pairs_[k].pair;
    PairChange& by = unknown.pairs[k];
    PairMotions motions = PairMotions::Zero();
    for (int c = 0; c < 4; ++c) {
      const int node = pair.stencil.node[c];
      if (node >= free_nodes) continue;
      const Vector3d d = at_node(solution_, place * free_nodes + node).cast<double>();
      motions.segment<3>(0) += pair.weights[c] * d;
      motions.segment<3>(3) += pair.along_first[c] * d;
      motions.segment<3>(6) += pair.along_second[c] * d;
    }
    by.update =
        by.right_side - pair.row.stiffness * motions.head<3>() + pair.force_by_motions * motions;
  }
}

// Forces of pairs count as the lengths by which their law gives way to them, m.
void Sensitivities::take_update(Unknown& unknown, int place) {
  const int components = 4 * assembly_.numbering.free_nodes;
  const int pairs = static_cast<int>(pairs_.size());
  Eigen::VectorXd now(components + 3 * pairs), update(components + 3 * pairs);
  for (int k = 0; k < components; ++k) {
    now[k] = unknown.derivative[k];
    update[k] = solution_[1L * place * components + k];
  }
  for (int p = 0; p < pairs; ++p) {
    const double stiffness = pairs_[p].pair->proximal.normal;
    now.segment<3>(components + 3 * p) = unknown.pairs[p].change / stiffness;
    update.segment<3>(components + 3 * p) = unknown.pairs[p].update / stiffness;
  }
  const Eigen::VectorXd next = unknown.acceleration.next(now, update);
  for (int k = 0; k < components; ++k) unknown.derivative[k] = next[k];
  for (int p = 0; p < pairs; ++p) {
    unknown.pairs[p].change = pairs_[p].pair->proximal.normal * next.segment<3>(components + 3 * p);
  }
}

}  // namespace sim_core
