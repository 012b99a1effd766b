#include "cloth/friction_turns.hpp"

#include <algorithm>

#include "cloth/constants.hpp"

namespace sim_core {

using Eigen::Vector3d;

Vector3d carried_by(int node, const SolvedStep& step) {
  const StepProblem& problem = step.problem;
  const ContactState& contact = step.newton.contact;
  const Vector3d before = at_node(problem.start, node);
  if (contact.touched[node] < static_cast<int>(problem.at_end.size())) {
    const BodyContact on = contact.body_contact(problem.at_end, at_node(step.x, node));
    const auto way = [&](int b) -> Vector3d {
      return carried(problem.at_start[b], problem.at_end[b], before) - before;
    };
    return on.body < 0 ? Vector3d::Zero().eval() : Vector3d(on.mean(way));
  }
  const Projection& at = contact.surfaces->projection(node);
  Vector3d way = Vector3d::Zero();
  for (int k = 0; k < 3; ++k) {
    const int corner = contact.surfaces->triangles()[at.triangle][k];
    way += at.weights[k] * (at_node(step.x, corner) - at_node(problem.start, corner));
  }
  return way;
}

FrictionTurns::Rubbing FrictionTurns::rubbing(int node, const SolvedStep& step) const {
  const ContactState& contact = step.newton.contact;
  if (contact.mode[node] == contact_open) return {};
  const Vector3d n = at_node(contact.normal, node).cast<double>();
  const Vector3d force = at_node(step.newton.residual, node);
  const double normal_force = force.dot(n);
  if (!(normal_force > 0.0)) return {};
  const Vector3d way = carried_by(node, step);
  Rubbing out{};
  out.touches = true;
  out.slides = contact.mode[node] == contact_slip;
  out.normal = normal_force / step.mass[node];
  out.friction = (force - normal_force * n) / normal_force;
  out.support = (way - way.dot(n) * n) / step.problem.dt;
  const Rubbing& last = last_[node];
  if (!last.touches) return out;
  const Vector3d change = out.support - last.support;
  out.is_even = !(change.norm() > shaken::even_gain * between(step));
  if (out.is_even) return out;
  out.gain = change / between(step);
  // What slides has all the friction there is.
  const double most = out.normal * std::max(last.friction.norm(), out.friction.norm());
  // What stuck may be set off at any instant since its velocity.
  const double since =
      last.slides ? between(step) : step.velocities.interval(node, step.problem.dt);
  out.outruns = (last.slides || out.slides) && change.norm() > most * since;
  return out;
}

void FrictionTurns::follow(const SolvedStep& step) {
  for (std::size_t i = 0; i < last_.size(); ++i) {
    const bool follows = !step.path.empty() && last_[i].touches;
    followed_[i] = follows ? follow_slip(static_cast<int>(i), step) : FollowedSlip{};
  }
}

double FrictionTurns::error(const SolvedStep& step, double lasts) const {
  double largest = 0.0;
  for (const FollowedSlip& end : followed_) {
    largest = std::max({largest, shaken::turns_that_add_up * end.misplaced,
                        shaken::lasting * lasts * end.uncertain});
  }
  if (!step.path.empty()) return largest;
  for (int i = 0; i < static_cast<int>(last_.size()); ++i) {
    const Rubbing now = rubbing(i, step);
    if (!now.outruns) continue;
    const double change = now.normal * (now.friction - last_[i].friction).norm();
    largest = std::max(largest, 0.5 * step.problem.dt * change * lasts);
  }
  return largest;
}

// What the velocity of a node lacks where its slip turned, m/s.
Vector3d FrictionTurns::missing(int node, const Rubbing& now, const SolvedStep& step) const {
  const Rubbing& last = last_[node];
  if (!now.outruns || !last.slides || last.friction.isZero(0.0)) return Vector3d::Zero();
  const double b = step.velocities.interval(node, step.problem.dt);
  const Vector3d slip = step.velocities.before(node) - (now.support - b * now.gain);
  const Vector3d friction = now.normal * last.friction, along = -friction.normalized();
  const double slowing = (now.gain - friction).dot(along);
  const double until = slip.dot(along) / slowing;
  if (!(slowing > 0.0 && until < b && until > -last_dt_)) return Vector3d::Zero();
  return (2.0 * until - b) * friction - b * now.normal * now.friction;
}

void FrictionTurns::store(const SolvedStep& step) {
  std::vector<Rubbing> next(last_.size());
  if (step.path.empty()) std::fill(followed_.begin(), followed_.end(), FollowedSlip{});
  for (int i = 0; i < static_cast<int>(last_.size()); ++i) {
    next[i] = rubbing(i, step);
    correction_[i] = step.path.empty() ? missing(i, next[i], step) : Vector3d::Zero();
    if (correction_[i].isZero(0.0)) continue;
    // It slides on, in the other direction.
    next[i].slides = true;
    next[i].friction = -last_[i].friction;
  }
  last_.swap(next);
  last_dt_ = step.problem.dt;
}

}  // namespace sim_core
