// Bodies that cloth touches: their gaps, normals and motion.
#pragma once

#include <Eigen/Core>
#include <array>
#include <vector>

namespace sim_core {

// At the end of a step. In its own axes a plane fills z < 0; a rounded body has all points within `radius` of a core,
// the box from -core to core: a point of a sphere, a line without ends of a cylinder.
struct Body {
  enum Shape : int { plane = 0, rounded = 1 };
  int shape;
  std::vector<double> mu;  // one, or one of each sheet
  Eigen::Vector3d core;    // m: 0 ... infinity
  double radius;           // m
  Eigen::Vector3d origin;  // m
  Eigen::Matrix3d rotation;

  // Half of its least extent, m: infinite of a plane.
  double half_thickness() const;
  double mu_of(int sheet) const { return mu.size() == 1 ? mu[0] : mu[sheet]; }
};

// Signed distance of a point from a body [m], negative inside, and the outward normal there.
struct Gap {
  double distance;
  Eigen::Vector3d normal;
};
Gap gap_of(const Body& body, const Eigen::Vector3d& x);

// Depth in a body of a point of a triangle that is deeper than `allowed`, or 0 where none is, up to 1 um, m.
double depth_beyond(const Body& body, const std::array<Eigen::Vector3d, 3>& triangle, double allowed);

// Where the motion from `begin` to `end` carries the material point of the body that is at x.
Eigen::Vector3d carried(const Body& begin, const Body& end, const Eigen::Vector3d& x);

// The body at a share of its motion from a to b: straight, and at an even turn.
Body between(const Body& a, const Body& b, double share);

}  // namespace sim_core
