#include "contact/state.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace sim_core {

using Eigen::Vector3d;

namespace {

bool began_near(const std::vector<Body>& bodies, const Vector3d& p, double distance_max) {
  return std::any_of(bodies.begin(), bodies.end(),
                     [&](const Body& body) { return gap_of(body, p).distance < distance_max; });
}

}  // namespace

void Norms::count(double force_squared) {
  squared += force_squared;
  if (!std::isnan(largest) && !(force_squared <= largest * largest)) largest = std::sqrt(force_squared);
}

ContactState::ContactState(int free_nodes, const NodeSettings& settings, double law_stiffness)
    : mode(free_nodes, contact_open),
      touched(free_nodes, -1),
      sheet(free_nodes, 0),
      stiffness(free_nodes, 0.0),
      normal(4 * free_nodes + 64, 0.0f),
      direction(4 * free_nodes + 64, 0.0f),
      mu(free_nodes, 0.0f),
      turning(free_nodes, 0.0f),
      force(4 * free_nodes + 64, 0.0f),
      correction(4 * free_nodes + 64, 0.0f),
      settings_(settings),
      turning_max_(settings.penalty / law_stiffness) {}

ContactRows ContactState::rows() const {
  return {mode.data(), normal.data(), direction.data(), mu.data(), turning.data()};
}

void ContactState::penalty(int node, double own, float* out) const {
  std::fill(out, out + 6, 0.0f);
  if (mode[node] == contact_open) return;
  const float k = static_cast<float>(settings_.penalty) * static_cast<float>(own);
  const float* n = &normal[4L * node];
  const float* t = &direction[4L * node];
  const float side = mode[node] == contact_stick ? k : std::min(turning[node], k);
  const float along = mode[node] == contact_stick ? k : 0.0f;
  // k n n^T + along t t^T + side (1 - n n^T - t t^T)
  int e = 0;
  for (int r = 0; r < 3; ++r) {
    for (int c = r; c < 3; ++c) {
      out[e++] = (k - side) * n[r] * n[c] + (along - side) * t[r] * t[c] + (r == c ? side : 0.0f);
    }
  }
}

Norms ContactState::sort(const Buffer<double>& x, const Buffer<double>& start, const Buffer<double>& residual,
                         const std::vector<Body>& at_start, const std::vector<Body>& at_end) {
  Norms norms;
  const int free_nodes = static_cast<int>(mode.size());
  for (int i = 0; i < free_nodes; ++i) {
    const Vector3d p = at_node(x, i);
    Gap gap{std::numeric_limits<double>::infinity(), Vector3d::UnitZ()};
    int which = -1;
    for (std::size_t b = 0; b < at_end.size(); ++b) {
      if (by_pairs(b)) continue;
      const Gap one = gap_of(at_end[b], p);
      if (one.distance < gap.distance) gap = one, which = static_cast<int>(b);
    }
    const Vector3d r = at_node(residual, i);
    const auto bears = [&] { return which >= 0 && r.dot(gap.normal) - stiffness[i] * gap.distance > 0.0; };
    // The nearest counts, but what began a step near a body does not change to a surface: pairs keep it from that.
    if (surfaces && !began_near(at_start, at_node(start, i), settings_.body_first)) {
      const std::optional<SmoothTouch> one = surfaces->touch(i, p);
      if (one && one->gap < gap.distance) {
        gap = {one->gap, one->normal};
        which = static_cast<int>(at_end.size()) + one->surface;
      }
    }
    if (!bears()) {
      touched[i] = -1;
      const ContactLinearization row = open_row(r);
      mode[i] = contact_open;
      at_node(force, i) = row.force.cast<float>();
      at_node(correction, i).setZero();
      norms.count(row.error_squared);
      continue;
    }
    const bool slipped = mode[i] == contact_slip && touched[i] == which;
    touched[i] = which;
    const ContactKinematics seen = kinematics(i, which, gap, x, start, residual, at_start, at_end);
    const ContactLinearization row = closed_row(seen, turning_max_);
    const bool reversed =
        slipped && row.mode == contact_slip && at_node(direction, i).cast<double>().dot(row.direction) < 0.0;
    at_node(normal, i) = gap.normal.cast<float>();
    write(i, hold_reversed && reversed ? sticking_row(seen) : row);
    norms.count(row.error_squared);
  }
  return norms;
}

void ContactState::keep(double dt) {
  kept_ = {mode, touched, direction, turning, dt};
  if (surfaces) surfaces->keep(mode);
}

void ContactState::forget() {
  kept_.dt = 0.0;
  if (surfaces) surfaces->restart();
}

bool ContactState::resume(const Buffer<double>& x, const Buffer<double>& start, const Buffer<double>& residual,
                          const std::vector<Body>& at_start, const std::vector<Body>& at_end, double dt) {
  if (!(kept_.dt > 0.0)) return false;
  for (std::size_t i = 0; i < mode.size(); ++i) {
    const int node = static_cast<int>(i), body = kept_.touched[i];
    if (kept_.mode[i] == contact_open || body < 0) continue;
    Gap gap{};
    if (body < static_cast<int>(at_end.size())) {
      gap = gap_of(at_end[body], at_node(x, node));
    } else {
      const std::optional<SmoothTouch> one = surfaces->touch(node, at_node(x, node));
      if (!one) continue;
      gap = {one->gap, one->normal};
    }
    const ContactKinematics seen = kinematics(node, body, gap, x, start, residual, at_start, at_end);
    touched[i] = body;
    at_node(normal, node) = gap.normal.cast<float>();
    // Friction turns the more easily the further a node slips, and it slips in proportion to dt.
    write(node, kept_.mode[i] == contact_stick ? sticking_row(seen)
                                               : slipping_row(seen, at_node(kept_.direction, node).cast<double>(),
                                                              static_cast<double>(kept_.turning[i]) * kept_.dt / dt));
  }
  return true;
}

ContactKinematics ContactState::kinematics(int node, int body, const Gap& gap, const Buffer<double>& x,
                                           const Buffer<double>& start, const Buffer<double>& residual,
                                           const std::vector<Body>& at_start, const std::vector<Body>& at_end) const {
  const Vector3d before = at_node(start, node), p = at_node(x, node);
  const bool is_body = body < static_cast<int>(at_end.size());
  Vector3d u = is_body ? Vector3d(p - carried(at_start[body], at_end[body], before)) : surfaces->slip(node, before, p);
  u -= u.dot(gap.normal) * gap.normal;
  const double mu_here = is_body ? at_end[body].mu_of(sheet[node]) : surfaces->mu(node);
  return {gap.distance, gap.normal, u, at_node(residual, node), mu_here, stiffness[node]};
}

void ContactState::write(int node, const ContactLinearization& row) {
  mode[node] = row.mode;
  at_node(direction, node) = row.direction.cast<float>();
  at_node(force, node) = row.force.cast<float>();
  at_node(correction, node) = row.correction.cast<float>();
  mu[node] = static_cast<float>(row.coupling);
  turning[node] = static_cast<float>(row.turning);
}

}  // namespace sim_core
