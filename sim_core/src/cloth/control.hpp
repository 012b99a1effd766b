// Step sizes by the error of prediction and by cost: the longest step is cut into a power of two of steps.
//
// The clock knows no frames: intervals of the length of the longest step follow each other from the start on, so that a
// run takes the same steps however it is watched. Only before an event, at which a step has to end, they are shorter.
//
// Implicit Euler is wrong by dt^2 a/2 in a step, and the prediction x + dt v by dt^2 a: their distance is the estimate
// of the error. A step that misses it, in which bodies or holders do not move as evenly, or that Newton's method does
// not solve within its patience, is taken back and halved. Steps grow where the error leaves room for it and where
// longer ones have not been dearer of late: work is counted in iterations and factors, not in seconds, so that a rerun
// takes the same steps.
#pragma once

#include <functional>
#include <vector>

#include "cloth/course.hpp"

namespace sim_core {

struct StepControl {
  double error;    // m: largest distance of a node from where it was predicted; infinite: all steps are the longest
  double longest;  // s: length of a step
  int finest;      // steps that one of this length is cut into at most for the error's sake: a power of two
};

// What drives the cloth at a time, kept by the caller.
using Motion = std::function<Drive(double time)>;

class StepController {
 public:
  StepController(Stepper& stepper, const StepControl& control, const ControlSettings& constants);

  // Takes one step from `time` [s], and sets that to its end. A step ends at `event`, which may be infinite.
  StepReport advance(double& time, double event, const Motion& motion, const Path& path);
  void restart();

 private:
  int ticks(int level) const;
  double work_of(const StepReport& report) const;
  void learn(int level, double work, double progress);
  bool worth_growing(int level) const;
  void begin_interval(double time, double event);

  Stepper& stepper_;
  Course course_;
  StepControl control_;
  ControlSettings constants_;
  int finest_, last_, level_;          // log2 of steps in an interval; `last_`: of the shortest
  int tick_;                           // in the interval, of the shortest steps
  double begin_ = 0.0, length_ = 0.0;  // of the interval, s
  std::vector<double> cost_;           // by level: work per interval of late, 0 where unknown
};

}  // namespace sim_core
