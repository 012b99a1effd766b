// Bodies that cloth touches: their gaps, normals and motion, and their cores.
#pragma once

#include <Eigen/Core>
#include <array>
#include <vector>

#include "contact/friction_cones.hpp"

namespace sim_core {

// At the end of a step. In its own axes a plane fills z < 0; a rounded body has all points within
// `radius` of a core, the box from -core to core: a point of a sphere, a line without ends of a
// cylinder.
struct Body {
  enum Shape : int { plane = 0, rounded = 1 };
  int shape;
  std::vector<double> mu;  // one, or one of each sheet
  Eigen::Vector3d core;    // m: 0 ... infinity
  double radius;           // m
  Eigen::Vector3d origin;  // m
  Eigen::Matrix3d rotation;
  std::vector<double> mu_static = {};  // as `mu`, and at least that; none: the same

  // Half of its least extent, m: infinite of a plane.
  double half_thickness() const;
  double mu_of(int sheet, Cone cone = Cone::sliding) const {
    const std::vector<double>& by_sheet =
        cone == Cone::resting && !mu_static.empty() ? mu_static : mu;
    return by_sheet.size() == 1 ? by_sheet[0] : by_sheet[sheet];
  }
};

// Signed distance of a point from a body [m], negative inside; the outward normal there, and
// whether the face is flat.
struct Gap {
  double distance;
  Eigen::Vector3d normal;
  bool flat = false;
};
Gap gap_of(const Body& body, const Eigen::Vector3d& x);

// Where the motion from `begin` to `end` carries the material point of the body that is at x.
Eigen::Vector3d carried(const Body& begin, const Body& end, const Eigen::Vector3d& x);

// The body at a share of its motion from a to b: straight, and at an even turn.
Body between(const Body& a, const Body& b, double fraction);

// The core of a body, which no cloth may pass: the body that got thinner from all sides until one
// dimension was left with no thickness. A ball's is its centre, a cylinder's its axis, and a box's
// a rectangle.
struct Core {
  double radius;  // m: distance from the core to the body's face, where that is nearest
  Eigen::Vector2d
      half;  // m: half edges of the rectangle, the longer first; infinite along a cylinder
  Eigen::Matrix3d axes;  // of the rectangle and across it, in the body's axes
};

// A plane's has an infinite radius.
Core core_of(const Body& body);

// Three corners in the axes of a core, at the start or the end of a step.
using Corners = std::array<Eigen::Vector3d, 3>;

// Whether a triangle whose corners go straight from `start` to `end` passes the core.
bool passes(const Core& core, const Corners& start, const Corners& end);

// Radius of a ball, a rod or the edges of a box, over the side of a cell, below which friction is
// not right: a strip over the edge of a box bears its force within 2 % at 0.9 (mu 0.6) and 7 % at
// 0.75, and below that it catches.
constexpr double radius_least = 0.9;

// Throws std::invalid_argument where a body is sharper than that for cloth whose cells have this
// side, m.
void refuse_sharp(const std::vector<Body>& bodies, double cell);

}  // namespace sim_core
