// Numbers by which the solver steps, and what a step reports.
#pragma once

#include <algorithm>
#include <limits>

#include "cloth/observed.hpp"

namespace sim_core {

struct ClothSettings {
  double tolerance;  // N: largest residual force of a node
  int newton_max;    // iterations of Newton's method in a step
  int krylov_max;    // of GMRES in one of those
  double krylov_tolerance;
  int refactor_after;  // GMRES iterations that a stale factor may cost
  int patience;        // iterations of Newton's method after which a step is halved rather than pursued
  int halvings_max;    // of a step that does not converge
};

struct StepReport {
  bool converged = true;
  double residual = 0.0;           // N: worst over the parts
  int steps = 0, unconverged = 0;  // steps that were taken, rejected ones apart
  int missed = 0;                  // of those, by steps of the controller that are further off than it allows
  int newton = 0, krylov = 0;
  double least_distance = std::numeric_limits<double>::infinity();  // m: of cloth from cloth at the ends of steps
  double sharpest = std::numeric_limits<double>::infinity();        // cells: least radius of a skeleton that bears
  double uneven = 0.0;          // m: distance of what drives the cloth from an even motion in a step of the controller
  double factorizations = 0.0;  // whole ones, and shares of those in part
  Observed seen;

  void add_work(const StepReport& other) {
    newton += other.newton;
    krylov += other.krylov;
    factorizations += other.factorizations;
  }
  void add(const StepReport& other) {
    add_work(other);
    steps += other.steps;
    unconverged += other.unconverged;
    missed += other.missed;
    converged = converged && other.converged;
    if (!(other.residual <= residual)) residual = other.residual;  // a NaN stays
    least_distance = std::min(least_distance, other.least_distance);
    sharpest = std::min(sharpest, other.sharpest);
    uneven = std::max(uneven, other.uneven);
    seen.add(other.seen);
  }
};

}  // namespace sim_core
