// Step sizes by the error of prediction and by cost: an interval of time is cut into a power of two of steps.
//
// Implicit Euler is wrong by dt^2 a/2 in a step, and the prediction x + dt v by dt^2 a: their distance is the estimate
// of the error. A step that misses it, or that Newton's method does not solve within its patience, is taken back and
// halved. Steps grow where the error leaves room for it and where longer ones have not been dearer of late: work is
// counted in iterations and factors, not in seconds, so that a rerun takes the same steps.
#pragma once

#include <functional>
#include <vector>

#include "cloth/stepping.hpp"

namespace sim_core {

struct StepControl {
  double error;          // m: largest distance of a node from where it was predicted
  int coarsest, finest;  // steps that an interval takes at least, and at most for the error's sake: powers of two
};

// What drives the cloth at a time, kept by the caller.
using Motion = std::function<Drive(double time)>;

class StepController {
 public:
  StepController(Stepper& stepper, const StepControl& control, const ControlSettings& constants);

  // From `begin` to `end` [s], an interval that is as long as all others.
  StepReport advance(double begin, double end, const Motion& motion);
  void restart();

 private:
  int ticks(int level) const;
  double work_of(const StepReport& report) const;
  void learn(int level, double work, double progress);
  bool worth_growing(int level) const;

  Stepper& stepper_;
  StepControl control_;
  ControlSettings constants_;
  int coarsest_, finest_, last_, level_;  // log2 of steps in an interval; `last_`: of the shortest
  std::vector<double> cost_;              // by level: work per interval of late, 0 where unknown
};

}  // namespace sim_core
