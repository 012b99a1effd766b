// The slip of cloth on what is shaken, followed through small parts of a step.
//
// A step has one direction of friction, and what cloth sticks to or slides on is taken to move
// evenly in it. A support that gains speed, A, faster than friction gives it to the cloth, mu N/m,
// is left, caught up with and passed within a step. Where the controller knows its way, each node
// is followed from the velocity v at the start of the step, through parts in which A is constant.
// With the slip s = v - (velocity of the support) and the acceleration a by all other forces,
//
//   dv/dt = a - (mu N/m) s/|s|             while s is not zero, and then
//         = A                              if |A - a| <= mu N/m: it sticks
//         = a + (mu N/m) (A - a)/|A - a|   else
//
// The node ends the step with that velocity. The place to which v leads differs from the place that
// was solved, and steps are halved until it does so by little.
#pragma once

#include <Eigen/Core>

#include "cloth/newton.hpp"
#include "cloth/support_path.hpp"
#include "cloth/velocities.hpp"

namespace sim_core {

// A step that was solved to x, and what it went on from.
struct SolvedStep {
  const StepProblem& problem;
  const Buffer<double>& x;
  const Newton& newton;
  const Velocities& velocities;
  const Buffer<double>& mass;  // (nodes), kg
  const Numbering& numbering;
  const SupportPath& path;
};

// How a node ends a step.
struct FollowedSlip {
  bool applies = false;      // else the step is right as it was solved
  Eigen::Vector3d normal;    // of the contact
  Eigen::Vector3d velocity;  // at the end, in the plane of contact, m/s
  Eigen::Vector3d gain;      // its rate there, m/s^2
  double misplaced = 0.0;    // m: by the step
  double uncertain = 0.0;    // m/s: of the velocity
};

// Of a node that was in contact before the step, too.
FollowedSlip follow_slip(int node, const SolvedStep& step);

}  // namespace sim_core
