// How contacts enter the sensitivities: the branch of each node's and pair's law, and its
// derivative.
#include "cloth/sensitive_contacts.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Length [m] and angle [rad] of the differences by which normals are differentiated.
constexpr double probe = 5e-7, probe_angle = 1e-5;

// Velocity of a point of a body by the parameter.
Vector3d rate_at(const Body& body, const BodyRate& rate, const Vector3d& point) {
  return rate.origin + rate.turn.cross(point - body.origin);
}

BodyRate rate_between(const std::vector<BodyRate>& before, const std::vector<BodyRate>& after,
                      int body, double share) {
  const BodyRate none;
  const BodyRate& from = before.empty() ? none : before[body];
  const BodyRate& to = after.empty() ? none : after[body];
  return {from.origin + share * (to.origin - from.origin),
          from.turn + share * (to.turn - from.turn)};
}

}  // namespace

Sensitivities::NodeContact Sensitivities::contact_of(int node, const Step& step) const {
  const ContactState& state = newton_.contact;
  const Vector3d p = at_node(step.x, node), before = at_node(step.start, node);
  const int bodies = static_cast<int>(step.at_end.size());
  NodeContact contact;
  contact.on = state.body_contact(step.at_end, p, node);
  if (state.mode[node] == contact_open) return contact;
  const bool on_surface = state.touched[node] >= bodies;
  if (on_surface) {
    const std::optional<SmoothTouch> touch = state.surfaces->touch_near(node, p);
    if (!touch) return contact;
    contact.on = {{touch->gap, touch->normal}, state.touched[node]};
  }
  const Contact at = state.contact_at(node, contact.on, step.x, step.start, newton_.residual,
                                      step.at_start, step.at_end);
  const LawResponse law = coulomb_law(at);
  contact.mode = law.mode;
  if (law.mode == contact_open) return contact;
  contact.curved = on_surface || contact.on.neighbours[0] >= 0 ||
                   step.at_end[contact.on.body].shape != Body::plane;
  contact.normal = at.normal;
  contact.force = at.force;
  contact.normal_force = at.normal_force();
  contact.bearing_force = std::max(contact.normal_force, 0.0) + at.pressed;
  contact.slip = at.slip;
  contact.direction = law.direction;
  contact.friction = state.mu_at(node, contact.on, p, law.direction, step.at_end);
  if (on_surface) {
    contact.turn = state.surfaces->turn(node);
    contact.way = state.surfaces->slip(node, before, p);
  } else {
    contact.turn = contact.on.average([&](int b) -> Matrix3d {
      return step.at_end[b].rotation * step.at_start[b].rotation.transpose();
    });
    contact.way = contact.on.average(
        [&](int b) -> Vector3d { return p - carried(step.at_start[b], step.at_end[b], before); });
  }
  const double bound = contact.friction.mu * contact.bearing_force;
  contact.turn_stiffness = turn_stiffness_of(bound, at.slip.norm(), at.stiffness);
  return contact;
}

// The rows of nodes in the linear problem, which are the same for all parameters.
void Sensitivities::classify_nodes(const Step& step) {
  for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
    const NodeContact& contact = nodes_[i] = contact_of(i, step);
    mode_[i] = contact.mode;
    coupling_[i] = turn_stiffness_[i] = 0.0f;
    if (contact.mode == contact_open) continue;
    at_node(normal_, i) = contact.normal.cast<float>();
    if (contact.mode == contact_stick) continue;
    at_node(direction_, i) = contact.direction.cast<float>();
    if (contact.normal_force > 0.0) coupling_[i] = static_cast<float>(contact.friction.mu);
    turn_stiffness_[i] = static_cast<float>(contact.turn_stiffness);
  }
}

// How much the coefficient of a node's contact changes by the parameter.
double Sensitivities::friction_rate(int parameter, int node, const NodeContact& contact) const {
  const int sheet = newton_.contact.sheet[node];
  const bool on_surface = contact.on.body >= bodies_;
  double rate = 0.0;
  for (const SensitivityTerm& by : parameters_[parameter]) {
    if (!by.is_of(newton_.contact.cone[node])) continue;
    if (by.is_friction_of_body() && !on_surface) {
      if (by.second >= 0 && by.second != sheet) continue;
      rate +=
          by.rate * contact.on.average([&](int b) -> double { return b == by.first ? 1.0 : 0.0; });
    }
    if (by.is_friction_of_pair() && on_surface) {
      const int surface = newton_.pairs->materials.sheets + contact.on.body - bodies_;
      if (by.first == sheet && by.second == surface) rate += by.rate;
    }
  }
  return contact.friction.by_mu * rate;
}

// `motion`: of the node over the body, m per unit; `turn` of the body, rad per unit.
Sensitivities::ContactChange Sensitivities::change_of(int node, const NodeContact& contact,
                                                      const Step& step, const Vector3d& motion,
                                                      const Vector3d& turn) const {
  ContactChange change;
  change.gap = contact.normal.dot(motion);
  const double size = motion.norm();
  if (!contact.curved) {
    change.normal = turn.cross(contact.normal);
    return change;
  }
  const Vector3d p = at_node(step.x, node);
  const ContactState& state = newton_.contact;
  const bool on_surface = contact.on.body >= bodies_;
  const auto seen_at = [&](const Vector3d& point) -> BodyContact {
    if (!on_surface) return state.body_contact(step.at_end, point, node);
    const std::optional<SmoothTouch> touch = state.surfaces->touch_near(node, point);
    return touch ? BodyContact{{touch->gap, touch->normal}, contact.on.body} : contact.on;
  };
  if (size > 0.0) {
    const Vector3d d = probe / size * motion;
    const double scale = size / (2.0 * probe);
    const BodyContact plus = seen_at(p + d), minus = seen_at(p - d);
    change.normal = scale * (plus.gap.normal - minus.gap.normal);
    if (on_surface) change.gap = scale * (plus.gap.distance - minus.gap.distance);
    if (contact.mode == contact_slip) {
      change.mu = scale * (state.mu_at(node, plus, p + d, contact.direction, step.at_end).mu -
                           state.mu_at(node, minus, p - d, contact.direction, step.at_end).mu);
    }
  }
  change.normal += turn.cross(contact.normal);
  return change;
}

// The change of a node's coefficient of friction as its direction turns by `turn`, a vector across
// it.
double Sensitivities::mu_by_direction(int node, const NodeContact& contact, const Step& step,
                                      const Vector3d& turn) const {
  const double size = turn.norm();
  if (!(contact.curved && size > 0.0)) return 0.0;
  const Vector3d p = at_node(step.x, node), d = probe_angle / size * turn;
  const auto mu_along = [&](const Vector3d& direction) {
    return newton_.contact.mu_at(node, contact.on, p, direction, step.at_end).mu;
  };
  return size / (2.0 * probe_angle) *
         (mu_along(contact.direction + d) - mu_along(contact.direction - d));
}

// `force_change`: of what the node needs from contact, N per unit.
void Sensitivities::linearize_node(int parameter, int place, int node, const Step& step,
                                   Vector3d force_change) {
  const NodeContact& contact = nodes_[node];
  Unknown& unknown = unknowns_[parameter];
  const auto expect_event = [&](double change) {
    unknown.nearest_event = std::min(unknown.nearest_event, change);
  };
  const State& state = states_[parameter];
  const DriveRates& rates = rates_of(parameter, step);
  const Vector3d d = at_node(unknown.derivative, node), d0 = at_node(state.x, node);
  const Vector3d p = at_node(step.x, node), before = at_node(step.start, node);
  // Motion of the body under the node by the parameter, and of the place from where the body
  // carried the node.
  Vector3d body_motion = Vector3d::Zero(), body_turn = Vector3d::Zero(),
           carried_motion = Vector3d::Zero();
  const bool moves = !(rates.bodies.empty() && state.bodies.empty());
  if (moves && contact.on.body >= 0 && contact.on.body < bodies_) {
    const auto end_of = [&](int b) {
      return rate_between(state.bodies, rates.bodies, b, step.end);
    };
    body_motion =
        contact.on.mean([&](int b) -> Vector3d { return rate_at(step.at_end[b], end_of(b), p); });
    body_turn = contact.on.mean([&](int b) -> Vector3d { return end_of(b).turn; });
    carried_motion = contact.on.average([&](int b) -> Vector3d {
      const Body &begin = step.at_start[b], &end = step.at_end[b];
      const BodyRate at_begin = rate_between(state.bodies, rates.bodies, b, step.begin);
      return rate_at(end, end_of(b), carried(begin, end, before)) -
             end.rotation * (begin.rotation.transpose() * rate_at(begin, at_begin, before));
    });
  }
  auto force = at_node(force_, place * assembly_.numbering.free_nodes + node);
  auto correction = at_node(unknown.correction, node);
  // What an opposite body presses changes with the distance of the two faces.
  double pressed_change = 0.0;
  if (contact.on.opposite >= 0) {
    const BodyContact& on = contact.on;
    const Vector3d& n = on.gap.normal;
    const Vector3d foot_motion = in_plane(d, n) + body_motion.dot(n) * n;
    const BodyRate rate =
        moves ? rate_between(state.bodies, rates.bodies, on.opposite, step.end) : BodyRate();
    const Vector3d across_motion = rate_at(step.at_end[on.opposite], rate, p);
    const double stiffness =
        compression * newton_.contact.area[node] / newton_.contact.thickness[node];
    pressed_change = -stiffness * on.across.normal.dot(foot_motion - across_motion);
    force_change -= pressed_change * on.across.normal;
  }
  if (contact.mode == contact_open) {
    force = -force_change.cast<float>();
    correction.setZero();
    if (contact.on.body >= 0) {
      expect_event(event_at(contact.on.gap.distance, contact.on.gap.normal.dot(d - body_motion)));
    }
    return;
  }
  const Vector3d& n = contact.normal;
  const ContactChange change = change_of(node, contact, step, d - body_motion, body_turn);
  const Vector3d way_change = d - contact.turn * d0 - carried_motion;
  const Vector3d slip_change =
      in_plane(way_change, n) - contact.way.dot(n) * in_plane(change.normal, n);
  const double normal_change = force_change.dot(n) + contact.force.dot(change.normal);
  const double own_rate = friction_rate(parameter, node, contact);
  const double mu = contact.friction.mu, pressing = contact.normal_force;
  const double load = contact.bearing_force, load_change = normal_change + pressed_change;
  if (contact.mode == contact_stick) {
    force.setZero();
    correction = -(change.gap * n + slip_change).cast<float>();
    const Vector3d friction = contact.force - pressing * n;
    const Vector3d friction_change =
        in_plane(force_change - normal_change * n - pressing * change.normal, n);
    const double size = friction.norm();
    expect_event(event_at(pressing, normal_change));
    expect_event(event_at(mu * load - size, own_rate * load + mu * load_change -
                                                (size > 0.0 ? friction.dot(friction_change) / size
                                                            : friction_change.norm())));
    return;
  }
  const Vector3d& t = contact.direction;
  const Vector3d across = slip_change - slip_change.dot(t) * t;
  const double length = contact.slip.norm();
  double mu_change = own_rate + change.mu;
  // The direction turns by -across/length. A contact that hardly slips is as good as stuck, and
  // turns no more than its bounded stiffness lets it.
  const double bound = mu * load;
  if (bound > 0.0)
    mu_change += mu_by_direction(node, contact, step, -contact.turn_stiffness / bound * across);
  Vector3d lacking = in_plane(force_change - normal_change * n - pressing * change.normal, n);
  lacking -= (coupling_[node] * load_change + mu_change * load) * t;
  lacking += contact.turn_stiffness * across;
  force = -lacking.cast<float>();
  correction = -(change.gap * n).cast<float>();
  expect_event(event_at(pressing, normal_change));
  expect_event(event_at(length, slip_change.dot(t)));
}

}  // namespace sim_core
