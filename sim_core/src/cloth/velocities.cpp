#include "cloth/velocities.hpp"

#include <algorithm>

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Way in a step, in m, below which cloth lies still: far above the rounding of positions, and far
// below the tolerance of gaps.
constexpr double still_distance = 1e-12;

// Largest ratio of steps that second order takes: it is stable up to 1 + sqrt(2).
constexpr double ratio_max = 2.2;

}  // namespace

Velocities::Velocities(int nodes, int free_nodes, bool second_order)
    : at_end(4L * nodes, 0.0),
      free_nodes_(free_nodes),
      second_order_(second_order),
      before_(at_end),
      acceleration_(at_end),
      continuing_(at_end),
      x_before_(at_end),
      v_before_(at_end),
      courses_(nodes, Course::free),
      age_(nodes, 0.0),
      passed_(nodes, 0.0),
      continued_(nodes, 0) {}

void Velocities::restart() {
  before_ = at_end;
  std::fill(acceleration_.begin(), acceleration_.end(), 0.0);
  std::fill(continuing_.begin(), continuing_.end(), 0.0);
  std::fill(courses_.begin(), courses_.end(), Course::free);
  std::fill(age_.begin(), age_.end(), 0.0);
  pushes_itself_ = pushed_itself_ = false;
  dt_before_ = 0.0;
}

bool Velocities::is_second_order(int node) const {
  return h_ > 0.0 && node < free_nodes_ && courses_[node] == Course::free;
}

void Velocities::begin(double dt, Inertia& inertia) {
  inertia.dt = dt;
  const double w = dt_before_ > 0.0 ? dt / dt_before_ : 0.0;
  a1_ = (1.0 + w) * (1.0 + w) / (1.0 + 2.0 * w);
  a2_ = 1.0 - a1_;
  const bool applies =
      second_order_ && w > 0.0 && w <= ratio_max && !pushes_itself_ && !pushed_itself_;
  h_ = applies ? dt * (1.0 + w) / (1.0 + 2.0 * w) : 0.0;
  int smooth = 0;
  for (int i = 0; i < static_cast<int>(age_.size()); ++i) {
    inertia.scheme[i] = is_second_order(i) ? Scheme::second_order : Scheme::staggered;
    smooth += is_second_order(i);
    if (is_second_order(i)) {
      at_node(before_, i) = at_node(at_end, i);
      age_[i] = 0.0;
    }
    const double passed = age_[i] - 0.5 * dt;
    passed_[i] = passed > 0.0 && rejuvenates_ ? passed : 0.0;
    if (!(passed > 0.0)) continue;
    age_[i] = 0.5 * dt;
    if (rejuvenates_) at_node(before_, i) += passed * at_node(continuing_, i);
  }
  // h of equal steps, so that a factor serves whatever the step before was.
  inertia.factor_step = 2 * smooth > free_nodes_ ? 2.0 / 3.0 * dt : dt;
}

void Velocities::set_inertia(int node, const Vector3d& x0, const Vector3d& gravity,
                             Inertia& inertia) const {
  const double dt = inertia.dt;
  const Vector3d v = at_node(before_, node);
  at_node(inertia.start, node) = x0;
  if (inertia.scheme[node] == Scheme::second_order) {
    const Vector3d origin = a1_ * x0 + a2_ * at_node(x_before_, node);
    const Vector3d momentum = a1_ * v + a2_ * at_node(v_before_, node);
    at_node(inertia.origin, node) = origin;
    at_node(inertia.target, node) = origin + h_ * momentum + h_ * h_ * gravity;
    at_node(inertia.euler_target, node) = x0 + dt * v + dt * dt * gravity;
    inertia.rate[node] = 1.0 / (h_ * h_);
    inertia.span[node] = h_;
    const Vector3d even = x0 + dt / dt_before_ * (x0 - at_node(x_before_, node));
    const Vector3d bent = x0 + dt * v + 0.5 * dt * dt * at_node(acceleration_, node);
    at_node(inertia.guess, node) = bends_ ? bent : even;
    at_node(inertia.other_guess, node) = bends_ ? even : bent;
    return;
  }
  const double b = interval(node, dt);
  at_node(inertia.origin, node) = x0;
  at_node(inertia.target, node) = x0 + dt * v + dt * b * gravity;
  inertia.rate[node] = 1.0 / (dt * b);
  inertia.span[node] = dt;
  at_node(inertia.guess, node) = x0 + dt * v;
  at_node(inertia.other_guess, node) = x0 + dt * v + dt * b * at_node(continuing_, node);
}

// Whether the acceleration in the step goes on to its end. An impact does not, nor does friction
// that stops what slides before the end.
bool Velocities::continues(int node, const Courses& courses, const Vector3d& at_end,
                           const Vector3d& middle) const {
  const Vector3d support = at_node(courses.support, node);
  switch (courses.of_node[node]) {
    case Course::free:
      return true;
    case Course::sliding:
      return courses_[node] != Course::free &&
             (courses.outrun[node] || (at_end - support).dot(middle - support) > 0.0);
    case Course::bound:
      break;
  }
  return false;
}

// Takes the way that led closer to the end of the step for the next guess.
void Velocities::update_guess(const Inertia& inertia, const Buffer<double>& x) {
  double chosen = 0.0, other = 0.0;
  for (int i = 0; i < free_nodes_; ++i) {
    if (inertia.scheme[i] != Scheme::second_order) continue;
    chosen += (at_node(x, i) - at_node(inertia.guess, i)).squaredNorm();
    other += (at_node(x, i) - at_node(inertia.other_guess, i)).squaredNorm();
  }
  if (other < chosen) bends_ = !bends_;
}

// The first step has no acceleration before it, and what lands or is held does not go on.
double Velocities::error_of(int node, const Vector3d& x, Course now, const Inertia& inertia) const {
  const bool goes_on =
      now != Course::bound && (courses_[node] != Course::free || now == Course::free);
  if (!(dt_before_ > 0.0) || node >= free_nodes_ || !goes_on) return 0.0;
  return std::min((x - at_node(inertia.guess, node)).norm(),
                  (x - at_node(inertia.other_guess, node)).norm());
}

// Returns whether the acceleration continues.
bool Velocities::update_staggered(int node, double dt, double b, const Vector3d& v,
                                  const Courses& courses) {
  at_node(acceleration_, node) = (v - at_node(before_, node)) / b;
  if (courses.followed[node]) {
    at_node(continuing_, node) = at_node(courses.gain, node);
    at_node(at_end, node) = at_node(before_, node) = v;
    continued_[node] = 0;
    return true;
  }
  const Vector3d change = 0.5 * dt / b * (v - at_node(before_, node));
  const bool goes_on = continues(node, courses, v + change, v);
  at_node(continuing_, node) = goes_on ? Vector3d(2.0 / dt * change) : at_node(courses.gain, node);
  at_node(at_end, node) = goes_on ? Vector3d(v + change) : v;
  at_node(before_, node) = v;
  continued_[node] = goes_on;
  return goes_on;
}

void Velocities::update(const Inertia& inertia, const Buffer<double>& x,
                        const Buffer<double>& middle, const Courses& courses) {
  const double dt = inertia.dt;
  update_guess(inertia, x);
  v_before_ = at_end;
  error_ = 0.0;
  bool lies_still = true, all_continue = true;
  for (int i = 0; i < static_cast<int>(courses_.size()); ++i) {
    const Vector3d v = at_node(middle, i);
    const Vector3d end = at_node(x, i);
    error_ = std::max(error_, error_of(i, end, courses.of_node[i], inertia));
    lies_still = lies_still && v.norm() * dt < still_distance;
    // What a body forces out of itself is taken to have begun outside.
    at_node(x_before_, i) = end - dt * v;
    if (inertia.scheme[i] == Scheme::second_order) {
      const Vector3d before = at_node(before_, i);
      const Vector3d at = (end - at_node(inertia.origin, i)) / h_;
      at_node(continuing_, i) = at_node(acceleration_, i) = (at - before) / dt;
      at_node(at_end, i) = at_node(before_, i) = at;
      continue;
    }
    const double b = inertia.scheme[i] == Scheme::euler ? dt : interval(i, dt);
    all_continue = update_staggered(i, dt, b, v, courses) && all_continue;
  }
  courses_ = courses.of_node;
  pushed_itself_ = pushes_itself_;
  pushes_itself_ = courses.pushes_itself;
  // Where cloth pushes cloth, momentum stays the same as long as all nodes follow one rule.
  rejuvenates_ = all_continue || !courses.pushes_itself;
  // Cloth that lies still does so until the next step begins, whatever then sets it in motion.
  for (int i = 0; i < static_cast<int>(age_.size()); ++i) {
    const bool at_instant =
        lies_still || courses.followed[i] || inertia.scheme[i] == Scheme::second_order;
    age_[i] = at_instant ? 0.0 : 0.5 * dt;
  }
  dt_before_ = dt;
}

}  // namespace sim_core
