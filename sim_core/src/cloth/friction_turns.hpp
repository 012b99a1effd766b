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
#pragma once

#include <Eigen/Core>
#include <vector>

#include "cloth/newton.hpp"
#include "cloth/velocities.hpp"

namespace sim_core {

// A step that was solved to x, and what it went on from.
struct SolvedStep {
  const StepProblem& problem;
  const Buffer<double>& x;
  const Newton& newton;
  const Velocities& velocities;
  const Buffer<double>& mass;  // (nodes), kg
};

class FrictionTurns {
 public:
  explicit FrictionTurns(int free_nodes)
      : last_(free_nodes), correction_(free_nodes, Eigen::Vector3d::Zero()) {}

  // A new run begins, without a last step.
  void restart() { last_.assign(last_.size(), {}); }
  // Largest velocity of a free node that is uncertain by the direction of friction, m/s.
  double error(const SolvedStep& step) const;
  // The step is taken.
  void store(const SolvedStep& step);

  // Of the last step: what its velocity lacks, m/s; the velocity of what the node touched [m/s], 0
  // where that moves evenly; and whether it gains speed faster than friction drives the cloth.
  const Eigen::Vector3d& correction(int node) const { return correction_[node]; }
  Eigen::Vector3d support(int node) const {
    return last_[node].is_even ? Eigen::Vector3d::Zero().eval() : last_[node].support;
  }
  // How fast that gains speed, m/s^2.
  const Eigen::Vector3d& gain(int node) const { return last_[node].gain; }
  bool outruns(int node) const { return last_[node].outruns; }

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
  double last_dt_ = 0.0;                     // s
};

}  // namespace sim_core
