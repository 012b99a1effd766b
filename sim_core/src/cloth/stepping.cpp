#include "cloth/stepping.hpp"

#include <algorithm>
#include <cmath>

#include "cloth/refusal.hpp"

namespace sim_core {
namespace {

// Iterations up to which steps may grow again, of those that a step may take.
constexpr double easy = 0.6;

}  // namespace

Stepper::Stepper(Assembly& assembly, const ClothSettings& settings)
    : x(4L * assembly.numbering.nodes, 0.0),
      v(x),
      newton(assembly, settings),
      assembly_(assembly),
      settings_(settings),
      start_(x),
      inertial_(x) {}

void Stepper::restart() {
  started_ = false;
  newton.contact.forget();
}

// Sets where inertia leads, and the ends of what is held, for the part from `begin` to `end` of the step.
void Stepper::drive_nodes(double begin, double end, double part, const Drive& drive) {
  const Numbering& numbering = assembly_.numbering;
  start_ = x;
  for (int i = 0; i < numbering.vertices; ++i) {
    const int node = numbering.node[i];
    at_node(inertial_, node) =
        at_node(start_, node) + part * at_node(v, node) + part * part * drive.gravity.row(i).transpose();
  }
  const double share = (end - begin) / (1.0 - begin);
  for (std::size_t h = 0; h < numbering.held.size(); ++h) {
    const int node = numbering.held[h];
    at_node(x, node) += share * (drive.held.row(h).transpose() - at_node(x, node));
  }
  for (int s = 0; s < numbering.slopes; ++s) {
    const int node = numbering.node[numbering.vertices + s];
    at_node(x, node) += share * (drive.slopes.row(s).transpose() - at_node(x, node));
  }
}

void Stepper::advance(double begin, double end, int depth, double dt, const Drive& drive, StepReport& report) {
  const double part = (end - begin) * dt;
  std::vector<Body> at_start, at_end;
  for (std::size_t b = 0; b < drive.bodies.size(); ++b) {
    at_start.push_back(between(bodies_before_[b], drive.bodies[b], begin));
    at_end.push_back(between(bodies_before_[b], drive.bodies[b], end));
  }
  const Buffer<double> from = x;
  drive_nodes(begin, end, part, drive);
  assembly_.read_table(start_);
  const StepProblem problem{part, drive.damping, start_, inertial_, v, at_start, at_end};
  const bool deepest = depth == settings_.halvings_max;
  const int iterations = report.newton;
  StepOutcome outcome{false, 0.0};
  if (depth >= depth_hint_) {
    assembly_.definite = depth > 0;  // where steps are hard, the matrix of a convex energy leads on more surely
    outcome = newton.solve(problem, x, false, deepest ? settings_.newton_max : settings_.patience, report);
    if (!outcome.converged && deepest) outcome = newton.solve(problem, x, true, settings_.newton_max, report);
  }
  if (!outcome.converged && !deepest) {
    if (depth >= depth_hint_) depth_hint_ = depth + 1;
    x = from;
    ++report.halvings;
    const double middle = 0.5 * (begin + end);
    advance(begin, middle, depth + 1, dt, drive, report);
    advance(middle, end, depth + 1, dt, drive, report);
    return;
  }
  hardest_ = std::max(hardest_, report.newton - iterations);
  newton.contact.keep(part);
  ++report.substeps;
  report.converged = report.converged && outcome.converged;
  if (!(outcome.residual <= report.residual)) report.residual = outcome.residual;  // a NaN stays
  for (int i = 0; i < assembly_.numbering.nodes; ++i) at_node(v, i) = (at_node(x, i) - at_node(start_, i)) / part;
}

StepReport Stepper::step(double dt, const Drive& drive) {
  const Numbering& numbering = assembly_.numbering;
  if (!(dt > 0.0) || !std::isfinite(dt)) refuse("dt: must be finite and > 0");
  if (drive.gravity.rows() != numbering.vertices) refuse("gravity: must have a row for each vertex");
  if (drive.held.rows() != static_cast<Eigen::Index>(numbering.held.size())) {
    refuse("held: must have a row for each held vertex");
  }
  if (drive.slopes.rows() != numbering.slopes) refuse("slopes: must have a row for each clamped edge");
  if (!drive.held.allFinite() || !drive.slopes.allFinite() || !drive.gravity.allFinite()) {
    refuse("held, slopes and gravity: must be finite");
  }
  if (!started_) bodies_before_ = drive.bodies;
  started_ = true;
  if (bodies_before_.size() != drive.bodies.size()) refuse("bodies: must keep their number");
  StepReport report;
  hardest_ = 0;
  advance(0.0, 1.0, 0, dt, drive, report);
  bodies_before_ = drive.bodies;
  if (hardest_ <= easy * settings_.patience && depth_hint_ > 0) --depth_hint_;
  for (int mode : newton.contact.mode) {
    report.contacts += mode != contact_open;
    report.sliding += mode == contact_slip;
  }
  return report;
}

}  // namespace sim_core
