// Velocities of the nodes between steps, in the staggered scheme.
//
// A step gives a node the velocity of its middle, v1 = (x1 - x0)/dt. The next step starts from it:
//
//   v1 = v0 + b a,   x1 = x0 + dt v1,   b = age + dt/2
//
// with the acceleration a at the end of the step, and the age of v0, the time since its instant.
// Under a constant acceleration this is exact, in flight as well as under sliding friction, and
// stiff motions are damped as by implicit Euler, of which it differs by b in place of dt.
#pragma once

#include <vector>

#include "math/buffer.hpp"

namespace sim_core {

// How a node moved in a step: free of contact, sliding on all that it touches, or with its motion
// prescribed by what it sticks to or what holds it.
enum class Course : char { free, sliding, bound };

// How the nodes moved in a step.
struct Courses {
  std::vector<Course> of_node;
  bool pushes_itself = false;  // whether cloth pushes cloth
};

class Velocities {
 public:
  explicit Velocities(int nodes);

  // (nodes, 4), m/s: at the end of the last step. A caller that sets them restarts.
  Buffer<double> at_end;

  // The next step starts from `at_end`, whose age is 0.
  void restart();
  // Before a step of dt [s]: makes velocities that are older than half of it as young as that. A
  // force that begins in a short step would otherwise act for half of the long one before, too.
  void rejuvenate(double dt);
  // (nodes, 4), m/s: from which the next step starts.
  const Buffer<double>& before() const { return before_; }
  // b of a step of dt, s.
  double interval(double dt) const { return age_ + 0.5 * dt; }
  // Takes the velocities at the middle of a step of dt, m/s, and how its nodes moved.
  void update(double dt, const Buffer<double>& middle, const Courses& courses);

 private:
  bool continues(int node, Course now, const Eigen::Vector3d& at_end,
                 const Eigen::Vector3d& middle) const;

  Buffer<double> before_;
  Buffer<double> acceleration_;  // (nodes, 4), m/s^2: 0 where it does not continue
  std::vector<Course> courses_;  // in the last step
  bool rejuvenates_ = true;
  double age_ = 0.0;  // of `before_`, s
};

}  // namespace sim_core
