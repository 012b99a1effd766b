#include "cloth/control.hpp"

#include <algorithm>
#include <cmath>

#include "cloth/refusal.hpp"

namespace sim_core {
namespace {

int level_of(int steps, const char* name) {
  int level = 0;
  while ((1 << level) < steps && level < 20) ++level;
  if ((1 << level) != steps) refuse(text(name, ": must be a power of two, got ", steps));
  return level;
}

}  // namespace

StepController::StepController(Stepper& stepper, const StepControl& control, const ControlSettings& constants)
    : stepper_(stepper),
      control_(control),
      constants_(constants),
      coarsest_(level_of(control.coarsest, "coarsest")),
      finest_(level_of(control.finest, "finest")),
      last_(finest_ + constants.halvings_near),
      level_(finest_),
      cost_(last_ + 1, 0.0) {
  if (!(control.error > 0.0) || !std::isfinite(control.error)) refuse("error: must be finite and > 0");
  if (coarsest_ > finest_) refuse("finest: must be at least coarsest");
}

void StepController::restart() {
  level_ = finest_;
  std::fill(cost_.begin(), cost_.end(), 0.0);
}

double StepController::work_of(const StepReport& report) const {
  return report.krylov + constants_.newton_work * report.newton + constants_.factor_work * report.factorizations;
}

int StepController::ticks(int level) const { return 1 << (last_ - level); }

void StepController::learn(int level, double work, double progress) {
  const double rate = work / progress;
  cost_[level] = cost_[level] > 0.0 ? (1.0 - constants_.novelty) * cost_[level] + constants_.novelty * rate : rate;
  for (int coarser = coarsest_; coarser < level; ++coarser) cost_[coarser] *= 1.0 - constants_.forgiven;
}

bool StepController::worth_growing(int level) const {
  return level > coarsest_ && !(cost_[level - 1] > constants_.dearer * cost_[level]);
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
    const int last = near ? last_ : finest_ + constants_.halvings;
    const double missed = stepper_.missed() / control_.error;
    if (solved ? level_ < finest_ && missed > constants_.reject_at : level_ < last) {
      stepper_.reject();
      total.add_work(report);
      ++total.halvings;
      learn(level_, constants_.rejected_work * work_of(report), share);
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
        level_ > finest_ ? stepper_.easy(report.newton, near) : missed < constants_.grow_at && worth_growing(level_);
    if (grows && tick % ticks(level_ - 1) == 0) --level_;
  }
  return total;
}

}  // namespace sim_core
