#include "cloth/velocities.hpp"

#include <algorithm>

namespace sim_core {
namespace {

// Way in a step, in m, below which cloth lies still: far above the rounding of positions, and far
// below the tolerance of gaps.
constexpr double still_distance = 1e-12;

}  // namespace

Velocities::Velocities(int nodes)
    : at_end(4L * nodes, 0.0),
      before_(at_end),
      acceleration_(at_end),
      courses_(nodes, Course::free) {}

void Velocities::restart() {
  before_ = at_end;
  std::fill(acceleration_.begin(), acceleration_.end(), 0.0);
  std::fill(courses_.begin(), courses_.end(), Course::free);
  age_ = 0.0;
}

void Velocities::rejuvenate(double dt) {
  const double passed = age_ - 0.5 * dt;
  if (!(passed > 0.0)) return;
  age_ = 0.5 * dt;
  if (!rejuvenates_) return;
  for (std::size_t i = 0; i < before_.size(); ++i) before_[i] += passed * acceleration_[i];
}

// Whether the acceleration in the step goes on to its end. An impact does not, nor does friction
// that stops what slides before the end.
bool Velocities::continues(int node, Course now, const Eigen::Vector3d& at_end,
                           const Eigen::Vector3d& middle) const {
  switch (now) {
    case Course::free:
      return true;
    case Course::sliding:
      return courses_[node] != Course::free && at_end.dot(middle) > 0.0;
    case Course::bound:
      break;
  }
  return false;
}

void Velocities::update(double dt, const Buffer<double>& middle, const Courses& courses) {
  const double b = interval(dt);
  bool lies_still = true, all_continue = true;
  for (int i = 0; i < static_cast<int>(courses_.size()); ++i) {
    const Eigen::Vector3d v = at_node(middle, i);
    const Eigen::Vector3d change = 0.5 * dt / b * (v - at_node(before_, i));
    const bool goes_on = continues(i, courses.of_node[i], v + change, v);
    at_node(acceleration_, i) =
        goes_on ? Eigen::Vector3d(2.0 / dt * change) : Eigen::Vector3d::Zero();
    at_node(at_end, i) = goes_on ? Eigen::Vector3d(v + change) : v;
    all_continue = all_continue && goes_on;
    lies_still = lies_still && v.norm() * dt < still_distance;
  }
  before_ = middle;
  courses_ = courses.of_node;
  // Where cloth pushes cloth, momentum stays the same as long as all nodes follow one rule.
  rejuvenates_ = all_continue || !courses.pushes_itself;
  // Cloth that lies still does so until the next step begins, whatever then sets it in motion.
  age_ = lies_still ? 0.0 : 0.5 * dt;
}

}  // namespace sim_core
