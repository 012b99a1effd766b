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
      kept_(track_),
      feet_(radius.size()) {
  for (const auto& corners : triangles)
    first_ = std::min(first_, *std::min_element(corners.begin(), corners.end()));
}

void SmoothContact::restart() {
  for (int& triangle : kept_.triangle) triangle = std::min(triangle, -1);
}

void SmoothContact::keep(const std::vector<int>& mode) {
  for (int i = 0; i < free_nodes_; ++i) {
    const bool stays = track_.triangle[i] >= 0 && mode[i] != contact_open && feet_[i].on_patch;
    kept_.triangle[i] = stays ? track_.triangle[i] : std::min(track_.triangle[i], -1);
    kept_.side[i] = track_.side[i];
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
  track_ = kept_;
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
    if (came && !forced(i, p, 0.0).isZero()) track_.triangle[i] = left_to_pairs;
  }
}

std::optional<SmoothTouch> SmoothContact::touch(int node, const Vector3d& p) {
  if (track_.triangle[node] < 0) return std::nullopt;
  const std::optional<Foot> found =
      patches_.foot(end_, p, track_.triangle[node], track_.side[node]);
  if (!found) return std::nullopt;
  if (found->on_patch) track_.triangle[node] = found->triangle;
  feet_[node] = *found;
  return SmoothTouch{found->height - apart(end_, node, *found), found->normal,
                     surface_of(found->triangle) - materials_.sheets};
}

// What a node keeps, m: pairs stay idle as long as the triangles around it lie on the surface.
double SmoothContact::apart(const PatchShape& shape, int node, const Foot& foot) const {
  const int sheet = sheet_of_node_[node], surface = surface_of(foot.triangle);
  const double r = radius_[node];
  const double curvature =
      patches_.curvature(shape, foot.triangle, foot.weights, track_.side[node]);
  const double sinking = 0.5 * r * r * std::min(curvature, settings_.curvature_max / r);
  return std::max(materials_.mean(sheet, surface), materials_.apart(sheet, surface) + sinking);
}

Vector3d SmoothContact::forced(int node, const Vector3d& before, double allowed) const {
  if (track_.triangle[node] < 0) return Vector3d::Zero();
  const std::optional<Foot> foot =
      patches_.foot(start_, before, track_.triangle[node], track_.side[node]);
  const double depth = foot ? apart(start_, node, *foot) - foot->height : 0.0;
  return depth > allowed ? depth * foot->normal : Vector3d::Zero().eval();
}

// The cloth is at p = y + (p - y) over the point y of the surface, and at the start of the step was
// somewhere, while that place was at y0 + Q^T (p - y); Q turns the surface's axes from then to now.
Vector3d SmoothContact::slip(int node, const Vector3d& before, const Vector3d& p) const {
  const Foot& foot = feet_[node];
  const Matrix3d turn = patches_.axes(end_, foot.triangle, foot.weights) *
                        patches_.axes(start_, foot.triangle, foot.weights).transpose();
  return p - foot.point + turn * (patches_.point(start_, foot.triangle, foot.weights) - before);
}

double SmoothContact::mu(int node) const {
  return materials_.mu(sheet_of_node_[node], surface_of(feet_[node].triangle));
}

void Norms::count(double force_squared) {
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
      mu(free_nodes, 0.0f),
      turning(free_nodes, 0.0f),
      force(4 * free_nodes + 64, 0.0f),
      correction(4 * free_nodes + 64, 0.0f),
      penalty_(settings.penalty),
      turning_max_(settings.penalty / settings.law_stiffness),
      fillet_(settings.fillet) {}

ContactRows ContactState::rows() const {
  return {mode.data(), normal.data(), direction.data(), mu.data(), turning.data()};
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

// With normals n_i as the rows of N, and a_i what gap i lacks of the fillet's radius, the least way
// out to where all gaps are that radius is w = N^-1 a = N^T l, where all l are positive; of two
// bodies, n_3 = n_1 x n_2 and a_3 = 0. The gap of the fillet is the radius less |w|, and the
// smallest gap counts. Round faces make corners of less than 66 degrees smaller and none below 53,
// for cloth comes out of the cusp under a box's edge; flat ones below 26 degrees.
Bearing ContactState::bearing(const std::vector<Body>& bodies, const Vector3d& p) const {
  Bearing on{{std::numeric_limits<double>::infinity(), Vector3d::UnitZ()}};
  std::array<Bearing, 6> near;  // those whose fillets may reach here, the nearest first
  int count = 0;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    if (by_pairs(b)) continue;
    Bearing one{gap_of(bodies[b], p), static_cast<int>(b)};
    if (one.gap.distance < on.gap.distance) on = one;
    if (!(one.gap.distance < 2.0 * fillet_)) continue;
    for (int k = 0; k < count; ++k) {
      if (one.gap.distance < near[k].gap.distance) std::swap(one, near[k]);
    }
    if (count < static_cast<int>(near.size())) near[count++] = one;
  }
  const auto radius_of = [&](const Gap& a, const Gap& b) {
    const double c = a.normal.dot(b.normal);
    return fillet_ * std::clamp(a.flat && b.flat ? 10.0 + 10.0 * c : 3.0 + 5.0 * c, 0.0, 1.0);
  };
  const auto lay = [&](int i, int j, int k) {
    const Gap &one = near[i].gap, &two = near[j].gap, &other = near[k].gap;
    const bool all = k != j;
    const double radius =
        std::min(radius_of(one, two),
                 all ? std::min(radius_of(one, other), radius_of(two, other)) : fillet_);
    Matrix3d normals;
    normals << one.normal, two.normal, all ? other.normal : one.normal.cross(two.normal);
    if (!(std::abs(normals.determinant()) > 1e-6)) return;  // parallel
    const Vector3d lacks(radius - one.distance, radius - two.distance,
                         all ? radius - other.distance : 0.0);
    const Matrix3d inverse = normals.inverse();
    const Vector3d way = inverse.transpose() * lacks, parts = inverse * way,
                   share = parts / parts.sum();
    const Gap laid{radius - way.norm(), way.normalized()};
    if (!(parts.head(all ? 3 : 2).minCoeff() > 0.0 && laid.distance < on.gap.distance)) return;
    on = {laid, near[i].body, {near[j].body, all ? near[k].body : -1}, {share[1], share[2]}};
  };
  for (int k = 1; k < count; ++k) {
    for (int j = 1; j <= k; ++j) {
      for (int i = 0; i < j; ++i) lay(i, j, k);
    }
  }
  return on;
}

Norms ContactState::sort(const Buffer<double>& x, const Buffer<double>& start,
                         const Buffer<double>& residual, const std::vector<Body>& at_start,
                         const std::vector<Body>& at_end) {
  Norms norms;
  const int free_nodes = static_cast<int>(mode.size());
  for (int i = 0; i < free_nodes; ++i) {
    const Vector3d p = at_node(x, i);
    Bearing on = bearing(at_end, p);
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
    const LawResponse& chosen = hold_reversed && reversed ? sticking(contact) : law;
    write(i, node_row(contact, chosen, turning_max_));
    norms.count(missed_squared(contact, law));
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

bool ContactState::resume(const Buffer<double>& x, const Buffer<double>& start,
                          const Buffer<double>& residual, const std::vector<Body>& at_start,
                          const std::vector<Body>& at_end, double dt) {
  if (!(kept_.dt > 0.0)) return false;
  for (std::size_t i = 0; i < mode.size(); ++i) {
    const int node = static_cast<int>(i), body = kept_.touched[i];
    if (kept_.mode[i] == contact_open || body < 0) continue;
    Bearing on;
    if (body < static_cast<int>(at_end.size())) {
      on = bearing(at_end, at_node(x, node));
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
        kept_.mode[i] == contact_stick
            ? sticking(contact)
            : slipping_along(contact, at_node(kept_.direction, node).cast<double>(),
                             static_cast<double>(kept_.turning[i]) * kept_.dt / dt);
    // The turning of the last step is not bounded again.
    write(node, node_row(contact, law, std::numeric_limits<double>::infinity()));
  }
  return true;
}

Vector3d ContactState::slip(const Bearing& on, const Vector3d& before, const Vector3d& p,
                            const std::vector<Body>& at_start, const std::vector<Body>& at_end) {
  const Vector3d u =
      on.mean([&](int b) -> Vector3d { return p - carried(at_start[b], at_end[b], before); });
  return u - u.dot(on.gap.normal) * on.gap.normal;
}

Contact ContactState::contact_at(int node, const Bearing& on, const Buffer<double>& x,
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
  mu[node] = static_cast<float>(row.coupling);
  turning[node] = static_cast<float>(row.turning);
}

}  // namespace sim_core
