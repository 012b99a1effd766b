// Numbers by which a preset lets the solver step. Its constants stand in cloth/constants.hpp and
// contact/constants.hpp.
#pragma once

namespace sim_core {

struct ClothSettings {
  double tolerance;  // N: largest residual force of a node
  int newton_max;    // iterations of Newton's method in a step
  double krylov_tolerance;
  int refactor_after;         // GMRES iterations that a stale factor may cost
  int newton_before_halving;  // iterations of Newton's method after which a step is halved rather
                              // than pursued
  int halvings_max;           // of a step that does not converge
  bool second_order;          // in time, of free nodes: see velocities.hpp
};

}  // namespace sim_core
