#include "contact/smooth.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <utility>

#include "cloth/problem.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

std::vector<double> creases(const std::vector<std::array<int, 3>>& triangles, const std::vector<int>& sheet_of_node,
                            int sheets, const std::vector<double>& crease) {
  std::vector<double> out;
  for (const auto& corners : triangles) out.push_back(crease[sheet_of_node[corners[0]] - sheets]);
  return out;
}

}  // namespace

SmoothContact::SmoothContact(std::vector<std::array<int, 3>> triangles, std::vector<int> sheet_of_node,
                             const ContactMaterials& materials, const std::vector<double>& crease,
                             const Buffer<double>& x, const std::vector<double>& radius, const SmoothSettings& settings)
    : sheet_of_node_(std::move(sheet_of_node)),
      radius_(radius),
      free_nodes_(static_cast<int>(radius.size())),
      materials_(materials),
      settings_(settings),
      patches_(triangles, x, creases(triangles, sheet_of_node_, materials.sheets, crease), settings),
      tree_(patches_.triangles(), x),
      track_{std::vector<int>(radius.size(), -1), std::vector<double>(radius.size(), 1.0)},
      kept_(track_),
      feet_(radius.size()) {
  for (const auto& corners : triangles) first_ = std::min(first_, *std::min_element(corners.begin(), corners.end()));
}

void SmoothContact::restart() { std::fill(kept_.triangle.begin(), kept_.triangle.end(), -1); }

void SmoothContact::keep(const std::vector<int>& mode) {
  for (int i = 0; i < free_nodes_; ++i) {
    const bool stays = track_.triangle[i] >= 0 && mode[i] != contact_open && feet_[i].on_patch;
    kept_.triangle[i] = stays ? track_.triangle[i] : -1;
    kept_.side[i] = track_.side[i];
  }
}

void SmoothContact::take_shapes(const Buffer<double>& start, const Buffer<double>& ends) {
  const auto same = [&](const PatchShape& shape, const Buffer<double>& x) {
    return shape.x.size() == x.size() && std::equal(x.begin() + 4L * first_, x.end(), shape.x.begin() + 4L * first_);
  };
  if (!same(start_, start)) {
    start_ = same(end_, start) ? end_ : patches_.shape(start);
    tree_.fit(start);
  }
  if (!same(end_, ends)) end_ = patches_.shape(ends);
}

void SmoothContact::begin(const Buffer<double>& start, const Buffer<double>& ends, const Buffer<double>& guess) {
  take_shapes(start, ends);
  // The largest of the box of motions of surfaces: middle and half diagonal.
  Eigen::AlignedBox3d ways;
  for (const auto& corners : patches_.triangles()) {
    for (int node : corners) ways.extend(at_node(ends, node) - at_node(start, node));
  }
  const Vector3d common = 0.5 * (ways.min() + ways.max());
  const double spread = 0.5 * ways.diagonal().norm();
  const double thickness = *std::max_element(materials_.thickness.begin(), materials_.thickness.end());
  track_ = kept_;
  for (int i = 0; i < free_nodes_; ++i) {
    if (track_.triangle[i] >= 0 || sheet_of_node_[i] < 0) continue;
    const Vector3d p = at_node(start, i);
    const double kept = thickness + 0.5 * settings_.curvature_max * radius_[i] + start_.bulge;  // at most
    const double reach = kept + settings_.reach * ((at_node(guess, i) - p - common).norm() + spread + thickness);
    const Nearest found =
        tree_.nearest(p, reach, [&](int t) { return materials_.mu(sheet_of_node_[i], surface_of(t)) >= 0.0; });
    track_.triangle[i] = found.triangle;
    if (found.triangle >= 0) track_.side[i] = patches_.side_of(start_, p, found.triangle, found.weights);
  }
}

std::optional<SmoothTouch> SmoothContact::touch(int node, const Vector3d& p) {
  if (track_.triangle[node] < 0) return std::nullopt;
  const std::optional<Foot> found = patches_.foot(end_, p, track_.triangle[node], track_.side[node]);
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
  const double curvature = patches_.curvature(shape, foot.triangle, foot.weights, track_.side[node]);
  const double sinking = 0.5 * r * r * std::min(curvature, settings_.curvature_max / r);
  return std::max(materials_.mean(sheet, surface), materials_.apart(sheet, surface) + sinking);
}

Vector3d SmoothContact::forced(int node, const Vector3d& before, double allowed) const {
  if (track_.triangle[node] < 0) return Vector3d::Zero();
  const std::optional<Foot> foot = patches_.foot(start_, before, track_.triangle[node], track_.side[node]);
  const double depth = foot ? apart(start_, node, *foot) - foot->height : 0.0;
  return depth > allowed ? depth * foot->normal : Vector3d::Zero().eval();
}

// The cloth is at p = y + (p - y) over the point y of the surface, and at the start of the step was somewhere, while
// that place was at y0 + Q^T (p - y); Q turns the surface's axes from then to now.
Vector3d SmoothContact::slip(int node, const Vector3d& before, const Vector3d& p) const {
  const Foot& foot = feet_[node];
  const Matrix3d turn =
      patches_.axes(end_, foot.triangle, foot.weights) * patches_.axes(start_, foot.triangle, foot.weights).transpose();
  return p - foot.point + turn * (patches_.point(start_, foot.triangle, foot.weights) - before);
}

double SmoothContact::mu(int node) const {
  return materials_.mu(sheet_of_node_[node], surface_of(feet_[node].triangle));
}

}  // namespace sim_core
