// Friction that turns within a step, because what the cloth lies on is shaken.
//
// A step has one direction of friction, that of its whole slip. What supports the cloth may gain
// speed faster, A, than friction can drive the cloth, |f| N/m. Then the slip s passes through zero
// within the step, and friction turns there. (Elsewhere the cloth sticks before its slip turns.) At
// the time t after the velocity before,
//
//   s(t) = s0 + (f N/m - A) t along -f,   which is zero at t*,
//
// with the friction f, over the normal force N, of the step before. Friction has acted along f
// until t*, and along -f since. The velocity is corrected by the difference of that to the friction
// of the step, and steps are halved until the difference is small.
//
// Where the controller knows the way of the support within the step, none of this applies: the slip
// of each node is followed through it (followed_slip.hpp).
#pragma once

#include <Eigen/Core>
#include <vector>

#include "cloth/followed_slip.hpp"

namespace sim_core {

// How far what a node touches carries the place where the node began the step, m.
Eigen::Vector3d carried_by(int node, const SolvedStep& step);

class FrictionTurns {
 public:
  explicit FrictionTurns(int free_nodes)
      : last_(free_nodes),
        correction_(free_nodes, Eigen::Vector3d::Zero()),
        followed_(free_nodes) {}

  // A new run begins, without a last step.
  void restart() { last_.assign(last_.size(), {}); }
  // Largest distance by which a free node is misplaced since friction turned, m. A velocity that is
  // uncertain by its direction counts as the place that it leads to in the time `lasts`, s.
  double error(const SolvedStep& step, double lasts) const;
  // Follows the slip of nodes through a step that was solved, if it has a path. Else they follow
  // nothing.
  void follow(const SolvedStep& step);
  // The step is taken.
  void store(const SolvedStep& step);

  // Of the last step: the velocity of a node with what the solved one lacks, m/s; the velocity of
  // what the node touched [m/s], 0 where that moves evenly; and whether that gains speed faster
  // than friction drives the cloth.
  Eigen::Vector3d corrected(int node, const Eigen::Vector3d& velocity) const {
    const FollowedSlip& end = followed_[node];
    if (!end.applies) return velocity + correction_[node];
    return end.velocity + velocity.dot(end.normal) * end.normal;
  }
  Eigen::Vector3d support(int node) const {
    return last_[node].is_even ? Eigen::Vector3d::Zero().eval() : last_[node].support;
  }
  // How fast that gains speed, m/s^2.
  const Eigen::Vector3d& gain(int node) const { return last_[node].gain; }
  bool outruns(int node) const { return last_[node].outruns; }
  const FollowedSlip& followed(int node) const { return followed_[node]; }

 private:
  struct Rubbing {
    bool touches = false, slides = false, is_even = true, outruns = false;
    double normal = 0.0;                                 // normal force over mass, m/s^2
    Eigen::Vector3d friction = Eigen::Vector3d::Zero();  // over the normal force
    Eigen::Vector3d support = Eigen::Vector3d::Zero();   // velocity of what the node touches, m/s
    Eigen::Vector3d gain = Eigen::Vector3d::Zero();      // of that velocity, m/s^2
  };
  Rubbing rubbing(int node, const SolvedStep& step) const;
  double between(const SolvedStep& step) const { return 0.5 * (last_dt_ + step.problem.dt); }
  Eigen::Vector3d missing(int node, const Rubbing& now, const SolvedStep& step) const;

  std::vector<Rubbing> last_;                // (free nodes)
  std::vector<Eigen::Vector3d> correction_;  // (free nodes)
  std::vector<FollowedSlip> followed_;       // (free nodes)
  double last_dt_ = 0.0;                     // s
};

}  // namespace sim_core
