// Contact of nodes with smooth surfaces of triangles: PN patches, their history and their slip.
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "contact/constants.hpp"
#include "contact/rows.hpp"
#include "contact/state.hpp"

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
                             const std::vector<double>& radius)
    : sheet_of_node_(std::move(sheet_of_node)),
      radius_(radius),
      free_nodes_(static_cast<int>(radius.size())),
      materials_(materials),
      patches_(triangles, x, creases(triangles, sheet_of_node_, materials.sheets, crease)),
      tree_(patches_.triangles(), x),
      touched_{std::vector<int>(radius.size(), -1), std::vector<double>(radius.size(), 1.0)},
      history_(touched_),
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
        touched_.triangle[i] >= 0 && mode[i] != contact_open && projections_[i].on_patch;
    history_.triangle[i] = stays ? touched_.triangle[i] : std::min(touched_.triangle[i], -1);
    history_.side[i] = touched_.side[i];
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
  touched_ = history_;
  for (int i = 0; i < free_nodes_; ++i) {
    const Vector3d p = at_node(start, i);
    const bool came = touched_.triangle[i] == left_to_pairs,
               near = began_near(at_start, p, obstacles::corner);
    if (near) touched_.triangle[i] = left_to_pairs;
    if (near || touched_.triangle[i] >= 0 || sheet_of_node_[i] < 0) continue;
    const double rest_distance_max =
        thickness + 0.5 * obstacles::curvature_max * radius_[i] + start_.bulge;
    const double reach =
        rest_distance_max +
        obstacles::reach * ((at_node(guess, i) - p - common).norm() + spread + thickness);
    const Nearest nearest = tree_.nearest(
        p, reach, [&](int t) { return materials_.mu(sheet_of_node_[i], surface_of(t)) >= 0.0; });
    touched_.triangle[i] = nearest.triangle;
    if (nearest.triangle < 0) continue;
    touched_.side[i] = patches_.side_of(start_, p, nearest.triangle, nearest.weights);
    if (came && !depenetration(i, p, 0.0).isZero()) touched_.triangle[i] = left_to_pairs;
  }
}

std::optional<SmoothTouch> SmoothContact::touch(int node, const Vector3d& p) {
  if (touched_.triangle[node] < 0) return std::nullopt;
  const std::optional<Projection> projection =
      patches_.projection(end_, p, touched_.triangle[node], touched_.side[node]);
  if (!projection) return std::nullopt;
  if (projection->on_patch) touched_.triangle[node] = projection->triangle;
  projections_[node] = *projection;
  return SmoothTouch{projection->height - rest_distance(end_, node, *projection),
                     projection->normal, surface_of(projection->triangle) - materials_.sheets};
}

// What a node keeps, m: pairs stay idle as long as the triangles around it lie on the surface.
double SmoothContact::rest_distance(const PatchShape& shape, int node,
                                    const Projection& projection) const {
  const int sheet = sheet_of_node_[node], surface = surface_of(projection.triangle);
  const double r = radius_[node];
  const double curvature =
      patches_.curvature(shape, projection.triangle, projection.weights, touched_.side[node]);
  const double sinking = 0.5 * r * r * std::min(curvature, obstacles::curvature_max / r);
  return std::max(materials_.mean(sheet, surface),
                  materials_.rest_distance(sheet, surface) + sinking);
}

Vector3d SmoothContact::depenetration(int node, const Vector3d& before, double allowed) const {
  if (touched_.triangle[node] < 0) return Vector3d::Zero();
  const std::optional<Projection> projection =
      patches_.projection(start_, before, touched_.triangle[node], touched_.side[node]);
  const double depth =
      projection ? rest_distance(start_, node, *projection) - projection->height : 0.0;
  return depth > allowed ? depth * projection->normal : Vector3d::Zero().eval();
}

// The cloth is at p = y + (p - y) over the point y of the surface, and at the start of the step was
// somewhere, while that place was at y0 + Q^T (p - y); Q turns the surface's axes from then to now.
Vector3d SmoothContact::slip(int node, const Vector3d& before, const Vector3d& p) const {
  const Projection& projection = projections_[node];
  return p - projection.point +
         turn(node) * (patches_.point(start_, projection.triangle, projection.weights) - before);
}

Matrix3d SmoothContact::turn(int node) const {
  const Projection& projection = projections_[node];
  return patches_.axes(end_, projection.triangle, projection.weights) *
         patches_.axes(start_, projection.triangle, projection.weights).transpose();
}

double SmoothContact::mu(int node, Cone cone) const {
  return materials_.friction(sheet_of_node_[node], surface_of(projections_[node].triangle), cone);
}

Vector3d SmoothContact::normal_near(int node, const Vector3d& p) const {
  const Projection& last = projections_[node];
  const std::optional<Projection> projection =
      patches_.projection(end_, p, last.triangle, touched_.side[node]);
  return projection ? projection->normal : last.normal;
}

std::optional<SmoothTouch> SmoothContact::touch_near(int node, const Vector3d& p) const {
  const std::optional<Projection> projection =
      patches_.projection(end_, p, projections_[node].triangle, touched_.side[node]);
  if (!projection) return std::nullopt;
  return SmoothTouch{projection->height - rest_distance(end_, node, *projection),
                     projection->normal, surface_of(projection->triangle) - materials_.sheets};
}

}  // namespace sim_core
