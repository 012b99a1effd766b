// Steps in time: driving forces, and halving of steps that do not converge.
#pragma once

#include <optional>
#include <vector>

#include "cloth/newton.hpp"
#include "contact/bodies.hpp"

namespace sim_core {

// A step that was taken.
struct StepTaken {
  const Buffer<double>&start, &x, &v;  // (nodes, 4): positions at its start and end [m], velocities at its end [m/s]
  const Points3& gravity;              // (vertices, 3), m/s^2
  const std::vector<Body>&at_start, &at_end;
};

// Looks at every step that was taken, and measures what the checks of a run judge.
class Watch {
 public:
  Watch(const ClothMesh& mesh, const Assembly& assembly);

  // The state was set: the energy of the next one is the first.
  void restart() { energy_.reset(); }
  // Throws std::invalid_argument where a triangle with a free corner is deeper in a body than `inside`, m.
  void refuse_inside(const Body& body, int number, double inside, const Buffer<double>& x) const;
  // `newton`: as the step left it.
  Observed see(const StepTaken& step, const Newton& newton);

 private:
  void see_energy(const StepTaken& step, const Newton& newton, Observed& out);
  void see_contacts(const StepTaken& step, const Newton& newton, Observed& out) const;
  double largest_stretch(const Buffer<double>& x) const;
  double depth_in(const Body& body, const Buffer<double>& x) const;
  int passages(const Body& begin, const Body& end, const StepTaken& step) const;

  const Assembly& assembly_;
  std::vector<int> nodes_;        // (triangles, 3)
  std::vector<double> inverse_;   // (triangles, 4): of the matrix of the two sides at rest, by columns, 1/m
  std::vector<double> cell_;      // (vertices): side of a square of two triangles, m
  double circle_ = 0.0;           // m: radius of the largest circle around a triangle
  std::optional<double> energy_;  // at the end of the last step, J
};

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
  // Forgets the contacts of the last step, which only begin the next: where closest points have changed they mislead it.
  void forget();
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
