// Bodies that cloth touches: their gaps, normals and motion.
#pragma once

#include <Eigen/Core>

namespace sim_core {

// At the end of a step. Its own axes: a plane fills z < 0, a sphere has radius size[0], a box reaches from -size to
// size, and a cylinder has radius size[0] and no ends along z.
struct Body {
  enum Shape : int { plane = 0, sphere = 1, box = 2, cylinder = 3 };
  int shape;
  double mu;
  Eigen::Vector3d size, origin;  // m
  Eigen::Matrix3d rotation;
};

// Signed distance of a point from a body [m], negative inside, and the outward normal there.
struct Gap {
  double distance;
  Eigen::Vector3d normal;
};
Gap gap_of(const Body& body, const Eigen::Vector3d& x);

// Where the motion from `begin` to `end` carries the material point of the body that is at x.
Eigen::Vector3d carried(const Body& begin, const Body& end, const Eigen::Vector3d& x);

// The body at a share of its motion from a to b: straight, and at an even turn.
Body between(const Body& a, const Body& b, double share);

}  // namespace sim_core
