// Velocities of the nodes between steps, and the schemes that take them through a step.
//
// Staggered: a step gives a node the velocity of its middle, v1 = (x1 - x0)/dt. The next step
// starts from it:
//
//   v1 = v0 + b a,   x1 = x0 + dt v1,   b = age + dt/2
//
// with the acceleration a at the end of the step, and the age of v0, the time since its instant.
// Under a constant acceleration this is exact, in flight as well as under sliding friction, and
// stiff motions are damped as by implicit Euler, of which it differs by b in place of dt.
//
// Second order: backward differences over two steps whose lengths have the ratio w = dt/dt_before
// [Hairer, Norsett & Wanner 1993, III.5], with velocities at the ends of steps:
//
//   v1 = (x1 - a1 x0 - a2 x_before)/h,   v1 = a1 v0 + a2 v_before + h a
//   a1 = (1 + w)^2/(1 + 2 w),   a2 = -w^2/(1 + 2 w),   h = dt (1 + w)/(1 + 2 w)
//
// It is for nodes that nothing touched in the last step. One that meets something in a step goes by
// Euler's scheme there, v1 = v0 + dt a: an impact is no smooth motion, and has no history.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "cloth/inertia.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// How a node moved in a step: free of contact, sliding on all that it touches, or with its motion
// prescribed by what it sticks to or what holds it.
enum class Course : char { free, sliding, bound };

// How the nodes moved in a step.
struct Courses {
  std::vector<Course> of_node;
  Buffer<double> support;      // (nodes, 4), m/s: of what a node slides on
  Buffer<double> gain;         // (nodes, 4), m/s^2: of the velocity of what a node sticks to
  std::vector<char> outrun;    // (nodes): whether that gains speed faster than friction gives it
  std::vector<char> followed;  // (nodes): whether the velocity given is that at the end of the
                               // step, and `gain` its rate
  bool pushes_itself = false;  // whether cloth pushes cloth
};

class Velocities {
 public:
  // `second_order`: whether free nodes, the first ones, go by the scheme of that name.
  Velocities(int nodes, int free_nodes, bool second_order);

  // (nodes, 4), m/s: at the end of the last step. A caller that sets them restarts.
  Buffer<double> at_end;

  // The next step starts from `at_end`, whose age is 0.
  void restart();
  // Chooses the schemes of a step of dt [s], and makes velocities that are older than half of it as
  // young as that. A force that begins in a short step would otherwise act for half of the long one
  // before, too.
  void begin(double dt, Inertia& inertia);
  // Sets the inertia of a node that is at x0 [m], under the acceleration of gravity, m/s^2.
  void set_inertia(int node, const Eigen::Vector3d& x0, const Eigen::Vector3d& gravity,
                   Inertia& inertia) const;
  // Takes how far each node went in the step over dt, m/s, and how nodes moved. x: at its end.
  void update(const Inertia& inertia, const Buffer<double>& x, const Buffer<double>& middle,
              const Courses& courses);
  // Velocity from which a node starts the next step, m/s, and b of a step of dt, s.
  Eigen::Vector3d before(int node) const { return at_node(before_, node); }
  double interval(int node, double dt) const { return age_[node] + 0.5 * dt; }
  // Whether a node touched nothing in the last step.
  bool was_free(int node) const { return courses_[node] == Course::free; }
  // Largest distance of a node that moved freely, or slid on, from where its velocity and
  // acceleration led it in the last step, m: an estimate of the error of the step.
  double error() const { return error_; }
  // (nodes, 4), m/s^2: of the last step.
  const Buffer<double>& acceleration() const { return acceleration_; }
  // Of the step at hand, for its derivative: the coefficients of second order, the time [s] by
  // which the velocity before a node's step was taken forward, and, once the step was taken,
  // whether the node's acceleration goes on to its end.
  double a1() const { return a1_; }
  double a2() const { return a2_; }
  double passed(int node) const { return passed_[node]; }
  bool continued(int node) const { return continued_[node] != 0; }

 private:
  bool continues(int node, const Courses& courses, const Eigen::Vector3d& at_end,
                 const Eigen::Vector3d& middle) const;
  bool is_second_order(int node) const;
  double error_of(int node, const Eigen::Vector3d& x, Course now, const Inertia& inertia) const;
  void update_guess(const Inertia& inertia, const Buffer<double>& x);
  bool update_staggered(int node, double dt, double b, const Eigen::Vector3d& middle,
                        const Courses& courses);

  int free_nodes_;
  bool second_order_;
  Buffer<double> before_;                     // (nodes, 4), m/s: from which a step starts
  Buffer<double> acceleration_, continuing_;  // (nodes, 4), m/s^2
  Buffer<double> x_before_, v_before_;  // (nodes, 4): at the start of the last step, m and m/s
  std::vector<Course> courses_;         // in the last step
  std::vector<double> age_;             // (nodes): of `before_`, s
  std::vector<double> passed_;          // (nodes), s
  std::vector<char> continued_;         // (nodes)
  bool rejuvenates_ = true;
  // Whether cloth pushed cloth in the last step, or in the one before: second order would change
  // the momentum of cloth in flight.
  bool pushes_itself_ = false, pushed_itself_ = false;
  bool bends_ = true;  // whether the guess has an acceleration
  double error_ = 0.0;
  double dt_before_ = 0.0;                // s; 0: there is no step before
  double a1_ = 1.0, a2_ = 0.0, h_ = 0.0;  // see above, in the step at hand
};

}  // namespace sim_core
