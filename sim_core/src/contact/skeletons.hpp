// Skeletons of bodies: the points, segments and faces of their cores, which cloth touches by pairs of closest points at
// the distance of the radius. What is small against a cell slips through between vertices, so vertices do not feel it.
#pragma once

#include <Eigen/Core>
#include <array>
#include <vector>

#include "contact/bodies.hpp"
#include "contact/skeleton_settings.hpp"

namespace sim_core {

struct Skeleton {
  int body;
  double radius;  // m
  bool whole;     // no vertex touches the body itself; else vertices do, and pairs hold what lies between them
  std::vector<Eigen::Vector3d> points;  // in the body's axes, m
  std::vector<std::array<int, 2>> segments;
  std::vector<std::array<int, 3>> triangles;  // with two corners alike: a segment, for vertices

  Eigen::Vector3d point(const Body& at, int i) const { return at.origin + at.rotation * points[i]; }
};

// Of those bodies whose radius is small against a cell [m]. An endless core ends `beyond` [m] from the cloth, which
// lies between `low` and `high`.
std::vector<Skeleton> skeletons_of(const std::vector<Body>& bodies, double cell, const Eigen::Vector3d& low,
                                   const Eigen::Vector3d& high, double beyond, const SkeletonSettings& settings);

}  // namespace sim_core
