// Cores of bodies, which no cloth may pass: bodies that got thinner from all sides until one dimension was left with no
// thickness. A ball's is its centre, a cylinder's its axis, and a box's a rectangle.
#pragma once

#include <array>

#include "contact/bodies.hpp"

namespace sim_core {

struct Core {
  double radius;         // m: distance from the core to the body's face, where that is nearest
  Eigen::Vector2d half;  // m: half edges of the rectangle, the longer first; infinite along a cylinder
  Eigen::Matrix3d axes;  // of the rectangle and across it, in the body's axes
};

// A plane's has an infinite radius.
Core core_of(const Body& body);

// Three corners in the axes of a core, at the start or the end of a step.
using Corners = std::array<Eigen::Vector3d, 3>;

// Whether a triangle whose corners go straight from `start` to `end` passes the core.
bool passes(const Core& core, const Corners& start, const Corners& end);

}  // namespace sim_core
