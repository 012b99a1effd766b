#include "cloth/control.hpp"

#include <algorithm>
#include <cmath>

#include "cloth/refusal.hpp"

namespace sim_core {
namespace {

// A step may miss the error by so much before it is taken back, and must meet it by so much before steps grow: twice
// the step makes four times the error.
constexpr double reject_at = 2.0, grow_at = 0.3;
// Work of a factor and of an evaluation, in GMRES iterations, and of what a rejected step loses besides.
constexpr double factor_work = 9.0, newton_work = 1.5;
// Longer steps may cost so much more per time than shorter ones before they are given up, and are forgiven so much of
// it with each step.
constexpr double dearer = 1.1, forgiving = 0.98, memory = 0.7;
// Times that a step may be halved further than the error asks for, where it is not solved; such steps grow again after
// one that took no more iterations than this. Near other cloth all steps take more, and halving is cheaper than other
// ways to solve them.
constexpr int hard = 2, hard_near = 4, easy = 6, easy_near = 15;

int level_of(int steps, const char* name) {
  int level = 0;
  while ((1 << level) < steps && level < 20) ++level;
  if ((1 << level) != steps) refuse(text(name, ": must be a power of two, got ", steps));
  return level;
}

double work_of(const StepReport& report) {
  return report.krylov + newton_work * report.newton + factor_work * report.factorizations;
}

}  // namespace

StepController::StepController(Stepper& stepper, const StepControl& control)
    : stepper_(stepper),
      control_(control),
      coarsest_(level_of(control.coarsest, "coarsest")),
      finest_(level_of(control.finest, "finest")),
      last_(finest_ + hard_near),
      level_(finest_),
      cost_(last_ + 1, 0.0) {
  if (!(control.error > 0.0) || !std::isfinite(control.error)) refuse("error: must be finite and > 0");
  if (coarsest_ > finest_) refuse("finest: must be at least coarsest");
}

void StepController::restart() {
  level_ = finest_;
  std::fill(cost_.begin(), cost_.end(), 0.0);
}

int StepController::ticks(int level) const { return 1 << (last_ - level); }

void StepController::learn(int level, double work, double progress) {
  const double rate = work / progress;
  cost_[level] = cost_[level] > 0.0 ? memory * cost_[level] + (1.0 - memory) * rate : rate;
  for (int coarser = coarsest_; coarser < level; ++coarser) cost_[coarser] *= forgiving;
}

bool StepController::worth_growing(int level) const {
  return level > coarsest_ && !(cost_[level - 1] > dearer * cost_[level]);
}

StepReport StepController::advance(double begin, double end, const Motion& motion) {
  if (!(end > begin) || !std::isfinite(end)) refuse("end: must be finite and beyond begin");
  const int all = ticks(0);
  StepReport total;
  for (int tick = 0; tick < all;) {
    while (tick % ticks(level_) != 0) ++level_;
    const int size = ticks(level_);
    const double share = static_cast<double>(size) / all, dt = share * (end - begin);
    const Drive drive = motion(begin + (end - begin) * (tick + size) / all);
    StepReport report;
    const bool solved = stepper_.attempt(dt, drive, report);
    const bool near = stepper_.near();
    const int last = near ? last_ : finest_ + hard;
    const double missed = stepper_.missed() / control_.error;
    if (solved ? level_ < finest_ && missed > reject_at : level_ < last) {
      stepper_.reject();
      total.add_work(report);
      ++total.halvings;
      learn(level_, 2.0 * work_of(report), share);
      ++level_;
      continue;
    }
    if (solved) {
      stepper_.accept(drive, report);
    } else {
      stepper_.reject();
      total.add_work(report);
      report = stepper_.step(dt, drive);
    }
    learn(level_, work_of(report), share);
    total.add(report);
    tick += size;
    const bool grows =
        level_ > finest_ ? report.newton <= (near ? easy_near : easy) : missed < grow_at && worth_growing(level_);
    if (grows && tick % ticks(level_ - 1) == 0) --level_;
  }
  return total;
}

}  // namespace sim_core
