// Steps in time: what drives them, and halving of those that do not converge.
#pragma once

#include <vector>

#include "cloth/newton.hpp"

namespace sim_core {

// At the end of a step.
struct Drive {
  const Points3& gravity;  // (V, 3), m/s^2
  const Points3& held;     // (held, 3), m
  const Points3& slopes;   // (clamped edges, 3)
  const std::vector<Body>& bodies;
  double damping;  // 1/s
};

class Stepper {
 public:
  Stepper(Assembly& assembly, const ClothSettings& settings);
  Stepper(const Stepper&) = delete;

  Buffer<double> x, v;  // (nodes, 4), m, m/s
  Newton newton;

  // Bodies are where they are in the first step from here.
  void restart();
  StepReport step(double dt, const Drive& drive);

 private:
  void advance(double begin, double end, int depth, double dt, const Drive& drive, StepReport& report);
  void drive_nodes(double begin, double end, double part, const Drive& drive);

  Assembly& assembly_;
  ClothSettings settings_;
  Buffer<double> start_, inertial_;
  std::vector<Body> bodies_before_;
  bool started_ = false;
  int depth_hint_ = 0, hardest_ = 0;  // halvings that steps need of late, and Newton iterations of the worst part
};

}  // namespace sim_core
