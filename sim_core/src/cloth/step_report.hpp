// What a step reports: work, quality, and the rungs of the fallback ladder that it took.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <limits>
#include <vector>

namespace sim_core {

// Rungs of the fallback ladder, in the order in which they are tried; stepping.hpp has the table of
// what each of them does.
enum class Rung : int { attempt, plain, stiff_pairs, smoothed_law, persistent, best_iterate };

constexpr std::array<const char*, 6> rung_names{"attempt",      "plain",      "stiff_pairs",
                                                "smoothed_law", "persistent", "best_iterate"};

// How often a rung was tried, and how often it converged. The best iterate never does.
struct RungCount {
  int tried = 0;
  int converged = 0;
};

// Of friction with one body, surface or sheet, J.
struct FrictionWork {
  double work = 0.0;   // of what slides
  double error = 0.0;  // estimate of the part of it by which cells are wrong
};

// Worst values over the accepted steps, which the checks of a run judge, see checks.py.
struct DiagnosticExtremes {
  double stretch = 0.0;  // largest principal stretch of a triangle at the end of a step
  double depth =
      0.0;  // largest depth in a body at the end of a step beyond what round bodies allow, cells
  int passages = 0;  // triangles that passed the core of a body
  double contact_work =
      0.0;            // J: of bodies on the cloth as it moves against them, where that is positive
  double flow = 0.0;  // J: sum of the sizes of all changes of energy and of all work
  double balance = 0.0;                // J: energy gained beyond the work of all forces
  double gain = 0.0;                   // J: the largest `balance` at the end of a step
  std::vector<FrictionWork> friction;  // with each body, then each surface, then each sheet

  void add(const DiagnosticExtremes& next) {
    stretch = std::max(stretch, next.stretch);
    depth = std::max(depth, next.depth);
    passages += next.passages;
    contact_work += next.contact_work;
    flow += next.flow;
    gain = std::max(gain, balance + next.gain);
    balance += next.balance;
    if (friction.size() < next.friction.size()) friction.resize(next.friction.size());
    for (std::size_t other = 0; other < next.friction.size(); ++other) {
      friction[other].work += next.friction[other].work;
      friction[other].error += next.friction[other].error;
    }
  }
};

struct StepReport {
  bool converged = true;
  double residual = 0.0;           // N: worst over the parts
  int steps = 0, unconverged = 0;  // steps that were taken, rejected ones apart
  double step_error = 0.0;  // m: the largest estimate of how far one step alone misplaces a vertex
  int newton = 0, krylov = 0;
  double least_distance =
      std::numeric_limits<double>::infinity();  // m: of cloth from cloth at the ends of steps
  double motion_error =
      0.0;  // m: distance of what drives the cloth from an even motion in a step of the controller
  double factorizations = 0.0;                       // whole ones, and shares of those in part
  std::array<RungCount, rung_names.size()> rungs{};  // by Rung
  DiagnosticExtremes extremes;

  void count(Rung rung, bool solved) {
    RungCount& counted = rungs[static_cast<std::size_t>(rung)];
    ++counted.tried;
    counted.converged += solved;
  }
  void add_work(const StepReport& other) {
    newton += other.newton;
    krylov += other.krylov;
    factorizations += other.factorizations;
    for (std::size_t r = 0; r < rungs.size(); ++r) {
      rungs[r].tried += other.rungs[r].tried;
      rungs[r].converged += other.rungs[r].converged;
    }
  }
  void add(const StepReport& other) {
    add_work(other);
    steps += other.steps;
    unconverged += other.unconverged;
    step_error = std::max(step_error, other.step_error);
    converged = converged && other.converged;
    if (!(other.residual <= residual)) residual = other.residual;  // a NaN stays
    least_distance = std::min(least_distance, other.least_distance);
    motion_error = std::max(motion_error, other.motion_error);
    extremes.add(other.extremes);
  }
};

}  // namespace sim_core
