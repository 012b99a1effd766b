// One curved PN triangle [Vlachos et al. 2001]: y(b) and N(b), see contact/pn_triangles.hpp, and the foot of a point.
#pragma once

#include <Eigen/Core>
#include <array>

#include "contact/smooth_settings.hpp"

namespace sim_core {

// Corners of a triangle after one of them.
inline int next(int corner) { return (corner + 1) % 3; }
inline int after_next(int corner) { return (corner + 2) % 3; }

struct PNPatch {
  std::array<Eigen::Vector3d, 3> corner, normal;
  std::array<Eigen::Vector3d, 3> near,
      far;                              // handles E_ij and E_ji of the edge opposite each corner, i the next corner
  std::array<Eigen::Vector3d, 3> bend;  // Q_ij of that edge
  Eigen::Vector3d middle;               // C

  Eigen::Vector3d y(const Eigen::Vector3d& b) const;
  Eigen::Vector3d n(const Eigen::Vector3d& b) const;
  // Derivatives by each coordinate of b.
  Eigen::Matrix3d dy(const Eigen::Vector3d& b) const;
  Eigen::Matrix3d dn(const Eigen::Vector3d& b) const;

  // Place s in [0, 1] on the curved edge opposite corner k, from the next corner on, that is closest to p.
  double closest_on_edge(int k, const Eigen::Vector3d& p) const;
};

// Root of y(b) + height n(b)/|n| = p, in the triangle or its continuation beyond the edges.
struct PNRoot {
  Eigen::Vector3d b, normal, point;
  double height = 0.0;  // m
  bool found = false;

  PNRoot(const PNPatch& patch, const Eigen::Vector3d& p, const SmoothSettings& settings);
};

}  // namespace sim_core
