#include "contact/state.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "contact/constants.hpp"
#include "contact/rows.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Cosine of the angle of two normals below which their faces are opposite: flat ones have a fillet
// up to here.
constexpr double opposite_cosine = -0.9;

// Round faces make corners of less than 66 degrees smaller and none below 53, for cloth comes out
// of the cusp under a box's edge; flat ones below 26 degrees.
double fillet_radius(const Gap& a, const Gap& b) {
  const double c = a.normal.dot(b.normal);
  return obstacles::corner *
         std::clamp(a.flat && b.flat ? 10.0 + 10.0 * c : 3.0 + 5.0 * c, 0.0, 1.0);
}

// Takes the fillet between three bodies, or two where the last two are one, for the contact if its
// gap is smaller.
//
// With normals n_i as the rows of N, and a_i what gap i lacks of the fillet's radius, the least way
// out to where all gaps are that radius is w = N^-1 a = N^T l, where all l are positive; of two
// bodies, n_3 = n_1 x n_2 and a_3 = 0. The gap of the fillet is the radius less |w|.
void lay_fillet(const std::array<const BodyContact*, 3>& bodies, BodyContact& on) {
  constexpr double parallel = 1e-6;  // determinant of unit normals
  const Gap& first = bodies[0]->gap;
  const Gap& second = bodies[1]->gap;
  const Gap& third = bodies[2]->gap;
  const bool has_third = bodies[2] != bodies[1];
  double radius = std::min(fillet_radius(first, second), obstacles::corner);
  if (has_third) {
    radius = std::min({radius, fillet_radius(first, third), fillet_radius(second, third)});
  }
  Matrix3d normals;
  normals << first.normal, second.normal,
      has_third ? third.normal : first.normal.cross(second.normal);
  if (!(std::abs(normals.determinant()) > parallel)) return;
  const Vector3d lacks(radius - first.distance, radius - second.distance,
                       has_third ? radius - third.distance : 0.0);
  const Matrix3d inverse = normals.inverse();
  const Vector3d displacement = inverse.transpose() * lacks;
  const Vector3d parts = inverse * displacement;
  const Vector3d fraction = parts / parts.sum();
  const Gap gap{radius - displacement.norm(), displacement.normalized()};
  if (!(parts.head(has_third ? 3 : 2).minCoeff() > 0.0 && gap.distance < on.gap.distance)) return;
  on = {gap,
        bodies[0]->body,
        {bodies[1]->body, has_third ? bodies[2]->body : -1},
        {fraction[1], fraction[2]}};
}

}  // namespace

void ForceNorms::count(double force_squared) {
  squared += force_squared;
  if (!std::isnan(largest) && !(force_squared <= largest * largest))
    largest = std::sqrt(force_squared);
}

ContactState::ContactState(int free_nodes)
    : mode(free_nodes, contact_open),
      touched(free_nodes, -1),
      sheet(free_nodes, 0),
      cell(free_nodes, 0.0),
      thickness(free_nodes, 0.0),
      area(free_nodes, 0.0),
      stiffness(free_nodes, 0.0),
      normal(4 * free_nodes + 64, 0.0f),
      direction(4 * free_nodes + 64, 0.0f),
      coupling(free_nodes, 0.0f),
      turn_stiffness(free_nodes, 0.0f),
      force(4 * free_nodes + 64, 0.0f),
      correction(4 * free_nodes + 64, 0.0f),
      cone(free_nodes, Cone::sliding) {}

ContactRows ContactState::rows() const {
  return {mode.data(), normal.data(), direction.data(), coupling.data(), turn_stiffness.data()};
}

void ContactState::factor_block(int node, double own_stiffness, float* out) const {
  std::fill(out, out + 6, 0.0f);
  if (mode[node] == contact_open) return;
  const float k = static_cast<float>(stiffness::factor) * static_cast<float>(own_stiffness);
  const float* n = &normal[4L * node];
  const float* t = &direction[4L * node];
  const float side = mode[node] == contact_stick ? k : std::min(turn_stiffness[node], k);
  const float along = mode[node] == contact_stick ? k : 0.0f;
  // k n n^T + along t t^T + side (1 - n n^T - t t^T)
  int e = 0;
  for (int r = 0; r < 3; ++r) {
    for (int c = r; c < 3; ++c) {
      out[e++] = (k - side) * n[r] * n[c] + (along - side) * t[r] * t[c] + (r == c ? side : 0.0f);
    }
  }
}

BodyContact ContactState::body_contact(const std::vector<Body>& bodies, const Vector3d& p) const {
  BodyContact on{{std::numeric_limits<double>::infinity(), Vector3d::UnitZ()}};
  std::array<BodyContact, 6> near;  // the bodies whose fillets may reach here, the nearest first
  int count = 0;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    BodyContact candidate{gap_of(bodies[b], p), static_cast<int>(b)};
    if (candidate.gap.distance < on.gap.distance) on = candidate;
    if (!(candidate.gap.distance < 2.0 * obstacles::corner)) continue;
    for (int k = 0; k < count; ++k) {
      if (candidate.gap.distance < near[k].gap.distance) std::swap(candidate, near[k]);
    }
    if (count < static_cast<int>(near.size())) near[count++] = candidate;
  }
  // The fillets of each two bodies, and of each three.
  for (int k = 1; k < count; ++k) {
    for (int j = 1; j <= k; ++j) {
      for (int i = 0; i < j; ++i) lay_fillet({&near[i], &near[j], &near[k]}, on);
    }
  }
  return on;
}

BodyContact ContactState::body_contact(const std::vector<Body>& bodies, const Vector3d& p,
                                       int node) const {
  BodyContact on = body_contact(bodies, p);
  const double h = thickness[node];
  if (on.body < 0 || on.neighbours[0] >= 0 || !(on.gap.distance < h)) return on;
  const Vector3d foot = p - on.gap.distance * on.gap.normal;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    if (static_cast<int>(b) == on.body) continue;
    const Gap gap = gap_of(bodies[b], foot);
    const bool faces = gap.normal.dot(on.gap.normal) < opposite_cosine;
    if (!(faces && gap.distance < std::min(h, on.across.distance))) continue;
    on.opposite = static_cast<int>(b);
    on.across = gap;
  }
  return on;
}

Vector3d ContactState::press(const BodyContact& on, int node) const {
  if (on.opposite < 0) return Vector3d::Zero();
  const double closed = 1.0 - on.across.distance / thickness[node];
  return compression * area[node] * closed * on.across.normal;
}

ForceNorms ContactState::classify_contacts(const Buffer<double>& x, const Buffer<double>& start,
                                           const Buffer<double>& residual,
                                           const std::vector<Body>& at_start,
                                           const std::vector<Body>& at_end) {
  ForceNorms norms;
  const int free_nodes = static_cast<int>(mode.size());
  for (int i = 0; i < free_nodes; ++i) {
    const Vector3d p = at_node(x, i);
    BodyContact on = body_contact(at_end, p, i);
    if (surfaces) {
      const std::optional<SmoothTouch> touch = surfaces->touch(i, p);
      if (touch && touch->gap < on.gap.distance)
        on = {{touch->gap, touch->normal}, static_cast<int>(at_end.size()) + touch->surface};
    }
    const Vector3d r = at_node(residual, i) - press(on, i);
    const bool bears = on.body >= 0 && r.dot(on.gap.normal) - stiffness[i] * on.gap.distance > 0.0;
    if (!bears) {
      touched[i] = -1;
      mode[i] = contact_open;
      at_node(force, i) = -r.cast<float>();
      at_node(correction, i).setZero();
      norms.count(r.squaredNorm());
      continue;
    }
    const bool slipped = mode[i] == contact_slip && touched[i] == on.body;
    touched[i] = on.body;
    if (resting_.applies) choose_cone(i, on, x, start, at_start, at_end);
    const Contact contact = contact_at(i, on, x, start, residual, at_start, at_end);
    const LawResponse law = coulomb_law(contact);
    const bool reversed = slipped && law.mode == contact_slip &&
                          at_node(direction, i).cast<double>().dot(law.direction) < 0.0;
    at_node(normal, i) = on.gap.normal.cast<float>();
    const LawResponse& chosen = stick_on_reversal && reversed ? sticking(contact) : law;
    write(i, node_row(contact, chosen, stiffness::turn_stiffness_max));
    norms.count(missed_squared(contact, law));
  }
  return norms;
}

void ContactState::store_history(double dt) {
  history_ = {mode, touched, direction, turn_stiffness, dt};
  if (resting_.applies) {
    resting_.mode = mode;
    resting_.touched = touched;
  }
  if (surfaces) surfaces->store_history(mode);
}

void ContactState::clear_history() {
  history_.dt = 0.0;
  if (surfaces) surfaces->restart();
}

void ContactState::restart() {
  clear_history();
  resting_.mode.clear();
}

bool ContactState::warm_start(const Buffer<double>& x, const Buffer<double>& start,
                              const Buffer<double>& residual, const std::vector<Body>& at_start,
                              const std::vector<Body>& at_end, double dt) {
  if (!(history_.dt > 0.0)) return false;
  for (std::size_t i = 0; i < mode.size(); ++i) {
    const int node = static_cast<int>(i), body = history_.touched[i];
    if (history_.mode[i] == contact_open || body < 0) continue;
    BodyContact on;
    if (body < static_cast<int>(at_end.size())) {
      on = body_contact(at_end, at_node(x, node), node);
      if (on.body != body) on = {gap_of(at_end[body], at_node(x, node)), body};
    } else {
      const std::optional<SmoothTouch> touch = surfaces->touch(node, at_node(x, node));
      if (!touch) continue;
      on = {{touch->gap, touch->normal}, body};
    }
    if (resting_.applies) choose_cone(node, on, x, start, at_start, at_end);
    const Contact contact = contact_at(node, on, x, start, residual, at_start, at_end);
    touched[i] = body;
    at_node(normal, node) = on.gap.normal.cast<float>();
    // Friction turns the more easily the further a node slips, and it slips in proportion to dt.
    const LawResponse law =
        history_.mode[i] == contact_stick
            ? sticking(contact)
            : slipping_along(contact, at_node(history_.direction, node).cast<double>(),
                             static_cast<double>(history_.turn_stiffness[i]) * history_.dt / dt);
    // The stiffness of the last step is not bounded again.
    write(node, node_row(contact, law, std::numeric_limits<double>::infinity()));
  }
  return true;
}

Vector3d ContactState::slip(const BodyContact& on, const Vector3d& before, const Vector3d& p,
                            const std::vector<Body>& at_start, const std::vector<Body>& at_end) {
  const auto over = [&](int b) -> Vector3d { return p - carried(at_start[b], at_end[b], before); };
  const Vector3d u = on.average(over);
  return u - u.dot(on.gap.normal) * on.gap.normal;
}

Contact ContactState::contact_at(int node, const BodyContact& on, const Buffer<double>& x,
                                 const Buffer<double>& start, const Buffer<double>& residual,
                                 const std::vector<Body>& at_start,
                                 const std::vector<Body>& at_end) const {
  const Vector3d before = at_node(start, node);
  const Vector3d p = at_node(x, node);
  const Vector3d& n = on.gap.normal;
  const Vector3d u = slip_to(node, on, before, p, at_start, at_end);
  const Vector3d pressing = press(on, node);
  const Vector3d force = at_node(residual, node) - pressing;
  Contact out{on.gap.distance, n, u, force, 0.0, stiffness[node], pressing.norm()};
  // Friction points where the law asks for it at the iterate.
  const Vector3d asked = out.friction() - out.stiffness * out.slip;
  out.mu = mu_at(node, on, p, asked, at_end).mu;
  return out;
}

// Half a cell before and behind along friction. Planes are flat, and fillets hollow: there cloth
// does not turn at nodes.
FrictionCoefficient ContactState::mu_at(int node, const BodyContact& on, const Vector3d& p,
                                        const Vector3d& friction,
                                        const std::vector<Body>& at_end) const {
  const bool on_surface = on.body >= static_cast<int>(at_end.size());
  const double mu =
      on_surface ? surfaces->mu(node, cone[node])
                 : on.average([&](int b) { return at_end[b].mu_of(sheet[node], cone[node]); });
  const bool turns = on_surface || (at_end[on.body].shape != Body::plane && on.neighbours[0] < 0 &&
                                    on.opposite < 0);
  const double size = friction.norm();
  if (!(turns && mu > 0.0 && size > 0.0)) return {mu};
  const Vector3d along = friction / size;
  const Vector3d half_cell = 0.5 * cell[node] * along;
  const auto normal_at = [&](const Vector3d& near) -> Vector3d {
    return on_surface ? surfaces->normal_near(node, near) : gap_of(at_end[on.body], near).normal;
  };
  return mu_between_cells(mu, {normal_at(p - half_cell), on.gap.normal, normal_at(p + half_cell)},
                          along);
}

void ContactState::write(int node, const NodeRow& row) {
  mode[node] = row.mode;
  at_node(direction, node) = row.direction.cast<float>();
  at_node(force, node) = row.force.cast<float>();
  at_node(correction, node) = row.correction.cast<float>();
  coupling[node] = static_cast<float>(row.coupling);
  turn_stiffness[node] = static_cast<float>(row.turn_stiffness);
}

}  // namespace sim_core
