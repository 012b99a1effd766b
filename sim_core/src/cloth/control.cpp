#include "cloth/control.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "math/refusal.hpp"

namespace sim_core {
namespace {

using Eigen::Array3d;
using Eigen::Vector3d;

// A ball around the cloth.
struct Around {
  Vector3d middle;
  double radius;
};

Around around(const Stepper& stepper) {
  const Numbering& numbering = stepper.numbering();
  Eigen::AlignedBox3d box;
  for (int i = 0; i < numbering.vertices; ++i) box.extend(at_node(stepper.x, numbering.node[i]));
  return {0.5 * (box.min() + box.max()), 0.5 * box.diagonal().norm()};
}

// Distance of a body's material points near the cloth from where they are taken to be: that of their middle, and what
// the turn adds over their radius. None where the cloth is further away than it is wide.
double apart(const Body& now, const Body& even, const Around& cloth) {
  if (std::min(gap_of(now, cloth.middle).distance, gap_of(even, cloth.middle).distance) > 2.0 * cloth.radius)
    return 0.0;
  Array3d extent = now.core.array() + now.radius;
  if (now.shape == Body::plane) extent.setConstant(HUGE_VAL);
  const Array3d middle = (even.rotation.transpose() * (cloth.middle - even.origin)).array();
  const Array3d low = (middle - cloth.radius).max(-extent).min(extent);
  const Array3d high = (middle + cloth.radius).min(extent).max(-extent);
  const Vector3d at = 0.5 * (low + high).matrix();
  const double reach = std::min(0.5 * (high - low).matrix().norm(), cloth.radius);
  const Vector3d way = now.origin + now.rotation * at - even.origin - even.rotation * at;
  return way.norm() + reach * (now.rotation - even.rotation).norm() / std::sqrt(2.0);
}

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

void Course::look(double begin, double end, int looks, const Path& path) {
  constexpr double golden = 0.6180339887498949, scatter = 0.2;
  times_.clear();
  for (int k = 0; k < looks; ++k) {
    const double place = 0.5 + scatter * (golden * k - std::floor(golden * k) - 0.5);
    times_.push_back(begin + (end - begin) * (k + place) / looks);
  }
  track_ = path(times_);
  if (!track_.points.allFinite() || !track_.poses.allFinite()) {
    refuse(text("motion: must be finite, and is not between ", begin, " and ", end, " s"));
  }
}

double Course::off(double begin, double end, const Stepper& stepper, const Drive& drive) const {
  const Numbering& numbering = stepper.numbering();
  const std::vector<Body>& before = stepper.bodies();
  const Eigen::Index held = drive.held.rows(), points = held + drive.others.rows();
  const auto count = static_cast<Eigen::Index>(drive.bodies.size()), times = static_cast<Eigen::Index>(times_.size());
  if (track_.points.rows() != times * points || track_.poses.rows() != 3 * times * count) {
    refuse("motion: held vertices, surfaces and bodies must keep their number");
  }
  if (held != static_cast<Eigen::Index>(numbering.held.size()) || before.size() != drive.bodies.size()) return 0.0;
  const Around cloth = around(stepper);
  double out = 0.0;
  for (Eigen::Index t = 0; t < times; ++t) {
    const double share = (times_[t] - begin) / (end - begin);
    if (!(share > 0.0 && share < 1.0)) continue;
    for (Eigen::Index p = 0; p < points; ++p) {
      const int node = p < held ? numbering.held[p] : numbering.node[numbering.vertices + p - held];
      const Vector3d from = at_node(stepper.x, node);
      const Vector3d to = (p < held ? drive.held.row(p) : drive.others.row(p - held)).transpose();
      out = std::max(out, (track_.points.row(t * points + p).transpose() - from - share * (to - from)).norm());
    }
    for (Eigen::Index b = 0; b < count; ++b) {
      const auto pose = track_.poses.middleRows<3>(3 * (t * count + b));
      Body now = drive.bodies[b];
      now.rotation = pose.leftCols<3>();
      now.origin = pose.col(3);
      out = std::max(out, apart(now, between(before[b], drive.bodies[b], share), cloth));
    }
  }
  return out;
}

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
