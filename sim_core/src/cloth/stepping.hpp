// Steps in time: driving forces, and halving of steps that do not converge.
#pragma once

#include <vector>

#include "cloth/watch.hpp"
#include "contact/skeletons.hpp"

namespace sim_core {

// At the end of a step.
struct Drive {
  const Points3& gravity;  // (V, 3), m/s^2
  const Points3& held;     // (held, 3), m
  const Points3& others;   // (vertices of surfaces, 3), m
  const std::vector<Body>& bodies;
  double damping;  // 1/s: on top of the fabrics' own
};

class Stepper {
 public:
  Stepper(const ClothMesh& mesh, Assembly& assembly, const ClothSettings& settings, const Constants& constants);
  Stepper(const Stepper&) = delete;

  Buffer<double> x, v;  // (nodes, 4), m, m/s
  Newton newton;

  int sheets = 1;
  std::vector<Skeleton> skeletons;

  // `bodies`: where they are; without, they do not move in the next step.
  void restart(const std::vector<Body>& bodies);
  bool started() const { return started_; }
  StepReport step(double dt, const Drive& drive);

  // One attempt at a step, as a whole and within the settings' patience, to be accepted or rejected: then nothing has
  // happened.
  bool attempt(double dt, const Drive& drive, StepReport& report);
  void accept(const Drive& drive, StepReport& report);
  void reject();
  // Whether pairs mattered in the last attempt, and whether a step of so many iterations is easy there: longer ones may
  // follow.
  bool near() const;
  bool easy(int iterations, bool near) const;
  // Largest distance of a free node from where it was predicted in the last attempt, m.
  double missed() const;

  // At the end of the last step.
  const std::vector<Body>& bodies() const { return bodies_before_; }
  const Numbering& numbering() const { return assembly_.numbering; }
  // Change of momentum over the last step, N.
  const Eigen::Vector3d& momentum_rate() const { return momentum_rate_; }

  // Throws std::invalid_argument where a free vertex, or a triangle with one, is inside a body.
  void refuse_inside(const std::vector<Body>& bodies) const;

 private:
  int patience(bool near) const;
  bool sweeps(const std::vector<Body>& at_start, const std::vector<Body>& at_end, double dt) const;
  StepOutcome solve_hard(const StepProblem& problem, const Buffer<double>& driven, StepReport& report);
  void check(double dt, const Drive& drive);
  Eigen::Vector3d forced(int node, const std::vector<Body>& at_start) const;
  void take(double dt, double residual, const Drive& drive, const std::vector<Body>& at_start,
            const std::vector<Body>& at_end, StepReport& report);
  bool solve_part(double begin, double end, double dt, const Drive& drive, StepReport& report);
  void drive_nodes(double begin, double end, double part, const Drive& drive, const std::vector<Body>& bodies);
  void place_skeletons(const std::vector<Body>& bodies);

  Assembly& assembly_;
  Watch watch_;
  ClothSettings settings_;
  SteppingSettings constants_;
  Buffer<double> start_, inertial_, predicted_;
  StepOutcome tried_{false, 0.0};
  double tried_dt_ = 0.0;
  Eigen::Vector3d momentum_rate_ = Eigen::Vector3d::Zero();
  std::vector<Body> bodies_before_;
  bool started_ = false;
  int halvings_ = 0;  // that steps need of late
};

}  // namespace sim_core
