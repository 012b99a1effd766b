#include "cloth/control.hpp"

#include <algorithm>
#include <cmath>

#include "cloth/refusal.hpp"

namespace sim_core {
namespace {

// Share of an interval by which instants differ that rounding has parted.
constexpr double same_instant = 1e-9;
// What accelerates by a is a dt^2 off its prediction, and a dt^2/8 off an even motion between the ends of a step.
constexpr double even_to_predicted = 8.0;

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
      finest_(std::isfinite(control.error) ? level_of(control.finest, "finest") : 0),
      last_(std::isfinite(control.error) ? finest_ + constants.halvings : 0),
      level_(finest_),
      tick_(ticks(0)),
      cost_(last_ + 1, 0.0) {
  if (!(control.error > 0.0)) refuse("error: must be > 0");
  if (!(control.longest > 0.0) || !std::isfinite(control.longest)) refuse("longest: must be finite and > 0");
}

void StepController::restart() {
  level_ = finest_;
  tick_ = ticks(0);
  std::fill(cost_.begin(), cost_.end(), 0.0);
}

double StepController::work_of(const StepReport& report) const {
  return report.krylov + constants_.newton_work * report.newton + constants_.factor_work * report.factorizations;
}

int StepController::ticks(int level) const { return 1 << (last_ - level); }

void StepController::learn(int level, double work, double progress) {
  const double rate = work / progress;
  cost_[level] = cost_[level] > 0.0 ? (1.0 - constants_.novelty) * cost_[level] + constants_.novelty * rate : rate;
  for (int coarser = 0; coarser < level; ++coarser) cost_[coarser] *= 1.0 - constants_.forgiven;
}

bool StepController::worth_growing(int level) const {
  return level > 0 && !(cost_[level - 1] > constants_.dearer * cost_[level]);
}

// As long as the longest step, or as many as it takes to the event, equally long.
void StepController::begin_interval(double time, double event) {
  const double count = std::ceil((event - time) / control_.longest * (1.0 - same_instant));
  begin_ = time;
  length_ = std::isfinite(event) ? (event - time) / count : control_.longest;
  tick_ = 0;
}

StepReport StepController::advance(double& time, double event, const Motion& motion, const Path& path) {
  if (!(event > time)) refuse(text("event: must be after ", time, " s, got ", event));
  const int all = ticks(0);
  const auto instant = [&](int tick) {
    const double at = begin_ + length_ * tick / all;
    return std::abs(event - at) <= same_instant * length_ ? event : at;
  };
  const bool ended = tick_ == all || time != instant(tick_), cut = event < instant(all);
  const bool halves = last_ > 0;
  if (ended || cut) {
    begin_interval(time, event);
    course_.look(begin_, begin_ + length_, halves ? constants_.looks : 1, path);
  }
  StepReport total;
  for (bool taken = false; !taken;) {
    while (tick_ % ticks(level_) != 0) ++level_;
    const int size = ticks(level_);
    const double share = static_cast<double>(size) / all, dt = share * length_;
    const Drive drive = motion(instant(tick_ + size));
    const double uneven = course_.off(instant(tick_), instant(tick_ + size), stepper_, drive);
    if (even_to_predicted * uneven > constants_.reject_at * control_.error && level_ < finest_) {
      ++level_;
      continue;
    }
    total.uneven = std::max(total.uneven, uneven);
    StepReport report;
    const bool solved = halves && stepper_.attempt(dt, drive, report);
    const bool near = stepper_.near();
    const double missed = std::max(stepper_.missed(), even_to_predicted * uneven) / control_.error;
    if (solved ? level_ < finest_ && missed > constants_.reject_at : level_ < last_) {
      stepper_.reject();
      total.add_work(report);
      learn(level_, constants_.rejected_work * work_of(report), share);
      ++level_;
      continue;
    }
    if (solved) {
      stepper_.accept(drive, report);
    } else {
      if (halves) stepper_.reject();
      total.add_work(report);
      report = stepper_.step(dt, drive);
    }
    report.missed = stepper_.missed() > constants_.reject_at * control_.error;
    learn(level_, work_of(report), share);
    total.add(report);
    tick_ += size;
    taken = true;
    const bool grows =
        level_ > finest_ ? stepper_.easy(report.newton, near) : missed < constants_.grow_at && worth_growing(level_);
    if (grows && tick_ % ticks(level_ - 1) == 0) --level_;
  }
  time = instant(tick_);
  return total;
}

}  // namespace sim_core
