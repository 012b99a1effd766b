// Numbers by which the solver steps, and what a step reports.
#pragma once

#include <algorithm>
#include <limits>

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

// Worst values over the accepted steps, which the checks of a run judge, see checks.py.
struct Observed {
  double stretch = 0.0;       // largest principal stretch of a triangle at the end of a step
  double depth = 0.0;         // largest depth in a body at the end of a step beyond what round bodies allow, cells
  int passages = 0;           // triangles that passed the core of a body
  double contact_work = 0.0;  // J: of bodies on the cloth as it moves against them, where that is positive
  double flow = 0.0;          // J: sum of the sizes of all changes of energy and of all work
  double balance = 0.0;       // J: energy gained beyond the work of all forces
  double gain = 0.0;          // J: the largest `balance` at the end of a step

  void add(const Observed& next) {
    stretch = std::max(stretch, next.stretch);
    depth = std::max(depth, next.depth);
    passages += next.passages;
    contact_work += next.contact_work;
    flow += next.flow;
    gain = std::max(gain, balance + next.gain);
    balance += next.balance;
  }
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
