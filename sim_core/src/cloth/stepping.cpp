#include "cloth/stepping.hpp"

#include <algorithm>
#include <cmath>

#include "math/refusal.hpp"

namespace sim_core {

Stepper::Stepper(const ClothMesh& mesh, Assembly& assembly, const ClothSettings& settings, const Constants& constants)
    : x(4L * assembly.numbering.nodes, 0.0),
      v(x),
      newton(assembly, settings, constants),
      assembly_(assembly),
      watch_(mesh, assembly),
      settings_(settings),
      constants_(constants.stepping),
      start_(x),
      inertial_(x),
      predicted_(x) {
  newton.strained_max = constants_.strained_long;
}

void Stepper::restart(const std::vector<Body>& bodies) {
  bodies_before_ = bodies;
  started_ = !bodies.empty();
  if (started_) place_skeletons(bodies);
  forget();
  watch_.restart();
}

void Stepper::forget() {
  newton.contact.forget();
  if (newton.pairs) newton.pairs->restart();
}

void Stepper::refuse_inside(const std::vector<Body>& bodies) const {
  const Numbering& numbering = assembly_.numbering;
  for (int i = 0; i < numbering.vertices; ++i) {
    if (numbering.node[i] >= numbering.free_nodes) continue;
    for (std::size_t b = 0; b < bodies.size(); ++b) {
      const double depth = -gap_of(bodies[b], at_node(x, numbering.node[i])).distance;
      if (depth <= constants_.inside) continue;
      refuse(
          text("positions: must not start inside a body, and vertex ", i, " is ", 1e3 * depth, " mm inside body ", b));
    }
  }
  // Whose vertices are on an edge rounded by half a cell sinks into it by 0.46 of that; from 1 on no step leads out.
  constexpr double sunk = 0.5;
  for (const Skeleton& one : skeletons) watch_.refuse_inside(bodies[one.body], one.body, sunk * one.radius, x);
}

void Stepper::place_skeletons(const std::vector<Body>& bodies) {
  int node = assembly_.numbering.nodes - assembly_.numbering.bones;
  for (const Skeleton& skeleton : skeletons) {
    const int count = static_cast<int>(skeleton.points.size());
    for (int p = 0; p < count; ++p) at_node(x, node++) = skeleton.point(bodies[skeleton.body], p);
  }
}

// Whether a vertex may jump over a body that it touches by its distance.
bool Stepper::sweeps(const std::vector<Body>& at_start, const std::vector<Body>& at_end, double dt) const {
  for (std::size_t b = 0; b < at_end.size(); ++b) {
    const double far = constants_.sweep * at_end[b].half_thickness();
    if (!std::isfinite(far) || newton.contact.by_pairs(b)) continue;
    for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
      const Eigen::Vector3d before = at_node(start_, i);
      const double way = (before + dt * at_node(v, i) - carried(at_start[b], at_end[b], before)).norm();
      if (way > far && gap_of(at_start[b], before).distance < way) return true;
    }
  }
  return false;
}

// Sets the inertial positions and the ends of held vertices, for the part from `begin` to `end` of the step.
void Stepper::drive_nodes(double begin, double end, double part, const Drive& drive, const std::vector<Body>& bodies) {
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
  for (int o = 0; o < numbering.others; ++o) {
    const int node = numbering.node[numbering.vertices + o];
    at_node(x, node) += share * (drive.others.row(o).transpose() - at_node(x, node));
  }
  place_skeletons(bodies);
}

int Stepper::patience(bool near) const {
  return static_cast<int>((near ? constants_.near_patience : 1.0) * settings_.patience);
}

bool Stepper::easy(int iterations, bool near) const { return iterations <= constants_.easy * patience(near); }

bool Stepper::near() const { return newton.pairs && newton.pairs->relevant(); }

// Where Newton's method fails near other cloth: with stiff pairs, else by way of a smoothed law.
StepOutcome Stepper::solve_hard(const StepProblem& problem, const Buffer<double>& driven, StepReport& report) {
  x = driven;
  newton.pairs->stiff = true;
  const StepOutcome outcome = newton.solve(problem, x, false, patience(near()), report, false);
  newton.pairs->stiff = false;
  if (outcome.converged) return outcome;
  x = driven;
  assembly_.definite = true;
  return newton.solve(problem, x, false, constants_.smooth_iterations, report, true);
}

// Solves for the state at the end of a part of a step. Where that fails it does nothing, unless no part is shorter:
// then the best is kept.
bool Stepper::solve_part(double begin, double end, double dt, const Drive& drive, StepReport& report) {
  const double part = (end - begin) * dt;
  std::vector<Body> at_start, at_end;
  for (std::size_t b = 0; b < drive.bodies.size(); ++b) {
    at_start.push_back(between(bodies_before_[b], drive.bodies[b], begin));
    at_end.push_back(between(bodies_before_[b], drive.bodies[b], end));
  }
  drive_nodes(begin, end, part, drive, at_end);
  if (halvings_ < settings_.halvings_max && sweeps(at_start, at_end, part)) {
    x = start_;
    return false;
  }
  const Buffer<double> driven = x;
  const StepProblem problem{part, drive.damping, start_, inertial_, v, at_start, at_end};
  const bool deepest = halvings_ == settings_.halvings_max;
  assembly_.definite = halvings_ > 0;  // where steps are hard, the matrix of a convex energy leads on more surely
  StepOutcome outcome =
      newton.solve(problem, x, false, deepest ? settings_.newton_max : patience(near()), report, false);
  if (!outcome.converged && near()) outcome = solve_hard(problem, driven, report);
  if (!outcome.converged && (deepest || !near())) {
    x = driven;
    outcome = newton.solve(problem, x, deepest, settings_.newton_max, report, false);
  }
  if (!outcome.converged && !deepest) {
    x = start_;
    return false;
  }
  report.converged = report.converged && outcome.converged;
  take(part, outcome.residual, drive, at_start, at_end, report);
  return true;
}

// How far bodies and surfaces push out what begins a step inside them, or nearer than it may be, m.
Eigen::Vector3d Stepper::forced(int node, const std::vector<Body>& at_start) const {
  Eigen::Vector3d out = Eigen::Vector3d::Zero();
  if (node >= assembly_.numbering.free_nodes) return out;
  if (newton.contact.surfaces && newton.contact.mode[node] != contact_open)
    out = newton.contact.surfaces->forced(node, at_node(start_, node), constants_.inside);
  for (std::size_t b = 0; b < at_start.size(); ++b) {
    if (newton.contact.by_pairs(b)) continue;
    const Gap gap = gap_of(at_start[b], at_node(start_, node));
    if (gap.distance < -constants_.inside) out -= gap.distance * gap.normal;
  }
  return out;
}

// Makes the state that was solved for that of the cloth. What a body forces out of itself gets no velocity by that.
void Stepper::take(double dt, double residual, const Drive& drive, const std::vector<Body>& at_start,
                   const std::vector<Body>& at_end, StepReport& report) {
  newton.contact.keep(dt);
  if (newton.pairs) {
    newton.pairs->keep();
    report.least_distance = std::min(report.least_distance, newton.pairs->least_distance());
  }
  if (!std::isnan(report.residual) && !(residual <= report.residual)) report.residual = residual;
  momentum_rate_.setZero();
  for (int i = 0; i < assembly_.numbering.nodes; ++i) {
    const Eigen::Vector3d before = at_node(v, i);
    at_node(v, i) = (at_node(x, i) - at_node(start_, i) - forced(i, at_start)) / dt;
    momentum_rate_ += assembly_.mass[i] / dt * (at_node(v, i) - before);
  }
  report.seen.add(watch_.see({start_, x, v, drive.gravity, at_start, at_end}, newton));
}

bool Stepper::attempt(double dt, const Drive& drive, StepReport& report) {
  check(dt, drive);
  drive_nodes(0.0, 1.0, dt, drive, drive.bodies);
  tried_dt_ = dt;
  predicted_ = x;
  if (sweeps(bodies_before_, drive.bodies, dt)) return false;
  assembly_.definite = near();
  const StepProblem problem{dt, drive.damping, start_, inertial_, v, bodies_before_, drive.bodies};
  newton.predict(problem, x, predicted_, false);
  newton.strained_max = constants_.strained_soon;
  assembly_.lag_from(start_, constants_.lag);
  tried_ = newton.solve(problem, x, false, patience(near()), report, false);
  assembly_.lag_from(start_, 0.0);
  newton.strained_max = constants_.strained_long;
  return tried_.converged;
}

void Stepper::accept(const Drive& drive, StepReport& report) {
  take(tried_dt_, tried_.residual, drive, bodies_before_, drive.bodies, report);
  ++report.steps;
  bodies_before_ = drive.bodies;
  if (newton.pairs) report.sharpest = std::min(report.sharpest, newton.pairs->sharpest());
}

void Stepper::reject() { x = start_; }

double Stepper::missed() const {
  double largest = 0.0;
  for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
    largest = std::max(largest, (at_node(x, i) - at_node(predicted_, i)).squaredNorm());
  }
  return std::sqrt(largest);
}

void Stepper::check(double dt, const Drive& drive) {
  const Numbering& numbering = assembly_.numbering;
  if (!(dt > 0.0) || !std::isfinite(dt)) refuse("dt: must be finite and > 0");
  if (!(drive.damping >= 0.0) || !std::isfinite(drive.damping)) {
    refuse(text("damping: must be finite and >= 0 [1/s], got ", drive.damping));
  }
  if (drive.gravity.rows() != numbering.vertices) refuse("gravity: must have a row for each vertex");
  if (drive.held.rows() != static_cast<Eigen::Index>(numbering.held.size())) {
    refuse("held: must have a row for each held vertex");
  }
  if (drive.others.rows() != numbering.others) refuse("surfaces: must keep their vertices");
  if (!drive.others.allFinite()) refuse("surfaces: positions must be finite");
  if (!drive.held.allFinite() || !drive.gravity.allFinite()) refuse("held and gravity: must be finite");
  if (!started_) {
    refuse_inside(drive.bodies);
    bodies_before_ = drive.bodies;
    place_skeletons(drive.bodies);
  }
  started_ = true;
  if (bodies_before_.size() != drive.bodies.size()) refuse("bodies: must keep their number");
  for (std::size_t b = 0; b < drive.bodies.size(); ++b) {
    const Body &before = bodies_before_[b], &now = drive.bodies[b];
    if (now.shape != before.shape || now.core != before.core || now.radius != before.radius || now.mu != before.mu) {
      refuse(text("bodies: must keep their shapes and friction, and body ", b, " does not"));
    }
  }
  for (const Body& body : drive.bodies) {
    if (body.mu.size() == 1 || static_cast<int>(body.mu.size()) == sheets) continue;
    refuse(text("mu: of a body must be one or of ", sheets, " sheets, got ", body.mu.size()));
  }
}

// In parts, each of which is a step halved some times: once more where it does not converge, and once less after one
// that was easy, where pairs make parts of a step unlike, or after a step that was.
StepReport Stepper::step(double dt, const Drive& drive) {
  check(dt, drive);
  StepReport report;
  const int all = 1 << settings_.halvings_max;
  const auto size = [&] { return all >> halvings_; };
  int hardest = 0;
  const auto ease = [&](int iterations) {
    if (halvings_ > 0 && easy(iterations, near())) --halvings_;
  };
  for (int tick = 0; tick < all;) {
    while (tick % size() != 0) ++halvings_;
    const int iterations = report.newton;
    const double begin = static_cast<double>(tick) / all, end = static_cast<double>(tick + size()) / all;
    if (!solve_part(begin, end, dt, drive, report)) {
      ++halvings_;
      continue;
    }
    tick += size();
    const int taken = report.newton - iterations;
    hardest = std::max(hardest, taken);
    if (newton.pairs && tick % (2 * size()) == 0) ease(taken);
  }
  if (!newton.pairs) ease(hardest);
  bodies_before_ = drive.bodies;
  ++report.steps;
  report.unconverged += !report.converged;
  if (newton.pairs) report.sharpest = std::min(report.sharpest, newton.pairs->sharpest());
  return report;
}

}  // namespace sim_core
