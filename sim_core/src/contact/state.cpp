#include "contact/state.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "contact/rows.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

std::vector<double> creases(const std::vector<std::array<int, 3>>& triangles,
                            const std::vector<int>& sheet_of_node, int sheets,
                            const std::vector<double>& crease) {
  std::vector<double> out;
  for (const auto& corners : triangles) out.push_back(crease[sheet_of_node[corners[0]] - sheets]);
  return out;
}

// In place of a triangle: the node is left to pairs.
constexpr int left_to_pairs = -2;

bool began_near(const std::vector<Body>& bodies, const Vector3d& p, double distance_max) {
  return std::any_of(bodies.begin(), bodies.end(),
                     [&](const Body& body) { return gap_of(body, p).distance < distance_max; });
}

// Round faces make corners of less than 66 degrees smaller and none below 53, for cloth comes out
// of the cusp under a box's edge; flat ones below 26 degrees.
double fillet_radius(const Gap& a, const Gap& b, double fillet) {
  const double c = a.normal.dot(b.normal);
  return fillet * std::clamp(a.flat && b.flat ? 10.0 + 10.0 * c : 3.0 + 5.0 * c, 0.0, 1.0);
}

// Takes the fillet between three bodies, or two where the last two are one, for the contact if its
// gap is smaller.
//
// With normals n_i as the rows of N, and a_i what gap i lacks of the fillet's radius, the least way
// out to where all gaps are that radius is w = N^-1 a = N^T l, where all l are positive; of two
// bodies, n_3 = n_1 x n_2 and a_3 = 0. The gap of the fillet is the radius less |w|.
void lay_fillet(const std::array<const BodyContact*, 3>& bodies, double fillet, BodyContact& on) {
  constexpr double parallel = 1e-6;  // determinant of unit normals
  const Gap& first = bodies[0]->gap;
  const Gap& second = bodies[1]->gap;
  const Gap& third = bodies[2]->gap;
  const bool has_third = bodies[2] != bodies[1];
  double radius = std::min(fillet_radius(first, second, fillet), fillet);
  if (has_third) {
    radius = std::min(
        {radius, fillet_radius(first, third, fillet), fillet_radius(second, third, fillet)});
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

SmoothContact::SmoothContact(std::vector<std::array<int, 3>> triangles,
                             std::vector<int> sheet_of_node, const ContactMaterials& materials,
                             const std::vector<double>& crease, const Buffer<double>& x,
                             const std::vector<double>& radius, const SmoothSettings& settings)
    : sheet_of_node_(std::move(sheet_of_node)),
      radius_(radius),
      free_nodes_(static_cast<int>(radius.size())),
      materials_(materials),
      settings_(settings),
      patches_(triangles, x, creases(triangles, sheet_of_node_, materials.sheets, crease),
               settings),
      tree_(patches_.triangles(), x),
      track_{std::vector<int>(radius.size(), -1), std::vector<double>(radius.size(), 1.0)},
      history_(track_),
      projections_(radius.size()) {
  for (const auto& corners : triangles)
    first_ = std::min(first_, *std::min_element(corners.begin(), corners.end()));
}

void SmoothContact::restart() {
  for (int& triangle : history_.triangle) triangle = std::min(triangle, -1);
}

void SmoothContact::store_history(const std::vector<int>& mode) {
  for (int i = 0; i < free_nodes_; ++i) {
    const bool stays =
        track_.triangle[i] >= 0 && mode[i] != contact_open && projections_[i].on_patch;
    history_.triangle[i] = stays ? track_.triangle[i] : std::min(track_.triangle[i], -1);
    history_.side[i] = track_.side[i];
  }
}

void SmoothContact::take_shapes(const Buffer<double>& start, const Buffer<double>& ends) {
  const auto same = [&](const PatchShape& shape, const Buffer<double>& x) {
    return shape.x.size() == x.size() &&
           std::equal(x.begin() + 4L * first_, x.end(), shape.x.begin() + 4L * first_);
  };
  if (!same(start_, start)) {
    start_ = same(end_, start) ? end_ : patches_.shape(start);
    tree_.fit(start);
  }
  if (!same(end_, ends)) end_ = patches_.shape(ends);
}

void SmoothContact::begin(const Buffer<double>& start, const Buffer<double>& ends,
                          const Buffer<double>& guess, const std::vector<Body>& at_start) {
  take_shapes(start, ends);
  // The largest of the box of motions of surfaces: middle and half diagonal.
  Eigen::AlignedBox3d ways;
  for (const auto& corners : patches_.triangles()) {
    for (int node : corners) ways.extend(at_node(ends, node) - at_node(start, node));
  }
  const Vector3d common = 0.5 * (ways.min() + ways.max());
  const double spread = 0.5 * ways.diagonal().norm();
  const double thickness =
      *std::max_element(materials_.thickness.begin(), materials_.thickness.end());
  track_ = history_;
  for (int i = 0; i < free_nodes_; ++i) {
    const Vector3d p = at_node(start, i);
    const bool came = track_.triangle[i] == left_to_pairs,
               near = began_near(at_start, p, settings_.body_first);
    if (near) track_.triangle[i] = left_to_pairs;
    if (near || track_.triangle[i] >= 0 || sheet_of_node_[i] < 0) continue;
    const double kept =
        thickness + 0.5 * settings_.curvature_max * radius_[i] + start_.bulge;  // at most
    const double reach =
        kept + settings_.reach * ((at_node(guess, i) - p - common).norm() + spread + thickness);
    const Nearest found = tree_.nearest(
        p, reach, [&](int t) { return materials_.mu(sheet_of_node_[i], surface_of(t)) >= 0.0; });
    track_.triangle[i] = found.triangle;
    if (found.triangle < 0) continue;
    track_.side[i] = patches_.side_of(start_, p, found.triangle, found.weights);
    if (came && !depenetration(i, p, 0.0).isZero()) track_.triangle[i] = left_to_pairs;
  }
}

std::optional<SmoothTouch> SmoothContact::touch(int node, const Vector3d& p) {
  if (track_.triangle[node] < 0) return std::nullopt;
  const std::optional<Projection> found =
      patches_.projection(end_, p, track_.triangle[node], track_.side[node]);
  if (!found) return std::nullopt;
  if (found->on_patch) track_.triangle[node] = found->triangle;
  projections_[node] = *found;
  return SmoothTouch{found->height - rest_distance(end_, node, *found), found->normal,
                     surface_of(found->triangle) - materials_.sheets};
}

// What a node keeps, m: pairs stay idle as long as the triangles around it lie on the surface.
double SmoothContact::rest_distance(const PatchShape& shape, int node,
                                    const Projection& projection) const {
  const int sheet = sheet_of_node_[node], surface = surface_of(projection.triangle);
  const double r = radius_[node];
  const double curvature =
      patches_.curvature(shape, projection.triangle, projection.weights, track_.side[node]);
  const double sinking = 0.5 * r * r * std::min(curvature, settings_.curvature_max / r);
  return std::max(materials_.mean(sheet, surface),
                  materials_.rest_distance(sheet, surface) + sinking);
}

Vector3d SmoothContact::depenetration(int node, const Vector3d& before, double allowed) const {
  if (track_.triangle[node] < 0) return Vector3d::Zero();
  const std::optional<Projection> projection =
      patches_.projection(start_, before, track_.triangle[node], track_.side[node]);
  const double depth =
      projection ? rest_distance(start_, node, *projection) - projection->height : 0.0;
  return depth > allowed ? depth * projection->normal : Vector3d::Zero().eval();
}

// The cloth is at p = y + (p - y) over the point y of the surface, and at the start of the step was
// somewhere, while that place was at y0 + Q^T (p - y); Q turns the surface's axes from then to now.
Vector3d SmoothContact::slip(int node, const Vector3d& before, const Vector3d& p) const {
  const Projection& projection = projections_[node];
  const Matrix3d turn = patches_.axes(end_, projection.triangle, projection.weights) *
                        patches_.axes(start_, projection.triangle, projection.weights).transpose();
  return p - projection.point +
         turn * (patches_.point(start_, projection.triangle, projection.weights) - before);
}

double SmoothContact::mu(int node) const {
  return materials_.mu(sheet_of_node_[node], surface_of(projections_[node].triangle));
}

void ForceNorms::count(double force_squared) {
  squared += force_squared;
  if (!std::isnan(largest) && !(force_squared <= largest * largest))
    largest = std::sqrt(force_squared);
}

ContactState::ContactState(int free_nodes, const ContactSettings& settings)
    : mode(free_nodes, contact_open),
      touched(free_nodes, -1),
      sheet(free_nodes, 0),
      stiffness(free_nodes, 0.0),
      normal(4 * free_nodes + 64, 0.0f),
      direction(4 * free_nodes + 64, 0.0f),
      coupling(free_nodes, 0.0f),
      turning(free_nodes, 0.0f),
      force(4 * free_nodes + 64, 0.0f),
      correction(4 * free_nodes + 64, 0.0f),
      penalty_(settings.penalty),
      turning_max_(settings.penalty / settings.law_stiffness),
      fillet_(settings.fillet) {}

ContactRows ContactState::rows() const {
  return {mode.data(), normal.data(), direction.data(), coupling.data(), turning.data()};
}

void ContactState::penalty(int node, double own, float* out) const {
  std::fill(out, out + 6, 0.0f);
  if (mode[node] == contact_open) return;
  const float k = static_cast<float>(penalty_) * static_cast<float>(own);
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

BodyContact ContactState::body_contact(const std::vector<Body>& bodies, const Vector3d& p) const {
  BodyContact on{{std::numeric_limits<double>::infinity(), Vector3d::UnitZ()}};
  std::array<BodyContact, 6> near;  // the bodies whose fillets may reach here, the nearest first
  int count = 0;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    if (by_pairs(b)) continue;
    BodyContact candidate{gap_of(bodies[b], p), static_cast<int>(b)};
    if (candidate.gap.distance < on.gap.distance) on = candidate;
    if (!(candidate.gap.distance < 2.0 * fillet_)) continue;
    for (int k = 0; k < count; ++k) {
      if (candidate.gap.distance < near[k].gap.distance) std::swap(candidate, near[k]);
    }
    if (count < static_cast<int>(near.size())) near[count++] = candidate;
  }
  // The fillets of each two bodies, and of each three.
  for (int k = 1; k < count; ++k) {
    for (int j = 1; j <= k; ++j) {
      for (int i = 0; i < j; ++i) lay_fillet({&near[i], &near[j], &near[k]}, fillet_, on);
    }
  }
  return on;
}

ForceNorms ContactState::classify_contacts(const Buffer<double>& x, const Buffer<double>& start,
                                           const Buffer<double>& residual,
                                           const std::vector<Body>& at_start,
                                           const std::vector<Body>& at_end) {
  ForceNorms norms;
  const int free_nodes = static_cast<int>(mode.size());
  for (int i = 0; i < free_nodes; ++i) {
    const Vector3d p = at_node(x, i);
    BodyContact on = body_contact(at_end, p);
    const Vector3d r = at_node(residual, i);
    const auto bears = [&] {
      return on.body >= 0 && r.dot(on.gap.normal) - stiffness[i] * on.gap.distance > 0.0;
    };
    if (surfaces) {
      const std::optional<SmoothTouch> one = surfaces->touch(i, p);
      if (one && one->gap < on.gap.distance)
        on = {{one->gap, one->normal}, static_cast<int>(at_end.size()) + one->surface};
    }
    if (!bears()) {
      touched[i] = -1;
      mode[i] = contact_open;
      at_node(force, i) = -r.cast<float>();
      at_node(correction, i).setZero();
      norms.count(r.squaredNorm());
      continue;
    }
    const bool slipped = mode[i] == contact_slip && touched[i] == on.body;
    touched[i] = on.body;
    const Contact contact = contact_at(i, on, x, start, residual, at_start, at_end);
    const LawResponse law = coulomb_law(contact);
    const bool reversed = slipped && law.mode == contact_slip &&
                          at_node(direction, i).cast<double>().dot(law.direction) < 0.0;
    at_node(normal, i) = on.gap.normal.cast<float>();
    const LawResponse& chosen = stick_on_reversal && reversed ? sticking(contact) : law;
    write(i, node_row(contact, chosen, turning_max_));
    norms.count(missed_squared(contact, law));
  }
  return norms;
}

void ContactState::store_history(double dt) {
  history_ = {mode, touched, direction, turning, dt};
  if (surfaces) surfaces->store_history(mode);
}

void ContactState::clear_history() {
  history_.dt = 0.0;
  if (surfaces) surfaces->restart();
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
      on = body_contact(at_end, at_node(x, node));
      if (on.body != body) on = {gap_of(at_end[body], at_node(x, node)), body};
    } else {
      const std::optional<SmoothTouch> one = surfaces->touch(node, at_node(x, node));
      if (!one) continue;
      on = {{one->gap, one->normal}, body};
    }
    const Contact contact = contact_at(node, on, x, start, residual, at_start, at_end);
    touched[i] = body;
    at_node(normal, node) = on.gap.normal.cast<float>();
    // Friction turns the more easily the further a node slips, and it slips in proportion to dt.
    const LawResponse law =
        history_.mode[i] == contact_stick
            ? sticking(contact)
            : slipping_along(contact, at_node(history_.direction, node).cast<double>(),
                             static_cast<double>(history_.turning[i]) * history_.dt / dt);
    // The turning of the last step is not bounded again.
    write(node, node_row(contact, law, std::numeric_limits<double>::infinity()));
  }
  return true;
}

Vector3d ContactState::slip(const BodyContact& on, const Vector3d& before, const Vector3d& p,
                            const std::vector<Body>& at_start, const std::vector<Body>& at_end) {
  const Vector3d u =
      on.mean([&](int b) -> Vector3d { return p - carried(at_start[b], at_end[b], before); });
  return u - u.dot(on.gap.normal) * on.gap.normal;
}

Contact ContactState::contact_at(int node, const BodyContact& on, const Buffer<double>& x,
                                 const Buffer<double>& start, const Buffer<double>& residual,
                                 const std::vector<Body>& at_start,
                                 const std::vector<Body>& at_end) const {
  const Vector3d before = at_node(start, node), p = at_node(x, node), &n = on.gap.normal;
  const Vector3d force = at_node(residual, node);
  if (on.body >= static_cast<int>(at_end.size())) {
    const Vector3d u = surfaces->slip(node, before, p);
    return {on.gap.distance, n, u - u.dot(n) * n, force, surfaces->mu(node), stiffness[node]};
  }
  const double mu_here = on.mean([&](int b) { return at_end[b].mu_of(sheet[node]); });
  return {on.gap.distance, n,       slip(on, before, p, at_start, at_end),
          force,           mu_here, stiffness[node]};
}

void ContactState::write(int node, const NodeRow& row) {
  mode[node] = row.mode;
  at_node(direction, node) = row.direction.cast<float>();
  at_node(force, node) = row.force.cast<float>();
  at_node(correction, node) = row.correction.cast<float>();
  coupling[node] = static_cast<float>(row.coupling);
  turning[node] = static_cast<float>(row.turning);
}

}  // namespace sim_core
