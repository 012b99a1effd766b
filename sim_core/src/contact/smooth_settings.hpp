// Constants of contact with smooth surfaces.
#pragma once

#include "math/named.hpp"

namespace sim_core {

struct SmoothSettings {
  // Distance up to which nodes search for surfaces, over what they may come near in the step: more than 1 for what
  // contact deflects. Sweep: 0.75 misses contacts and takes 41 % more on a ball, 3 takes 2 % more.
  double reach = 1.5;
  // Bound of the curvature that counts, times the radius of a triangle's circle: a triangle sinks by a quarter of that
  // radius at most, and sharper surfaces poke through between nodes. Sweep: 0.25 moves a sheet on a ball by 0.03 mm and
  // takes 9 % more, 1 changes nothing.
  double curvature_max = 0.5;
  // Sine of the angle of the normals of the two sides of an edge below which they are one. Sweep: nothing changes.
  double same_normal = 1e-3;
  // Barycentric distance beyond an edge at which the search for a foot goes on in the next triangle. Sweep: nothing
  // changes.
  double beyond_edge = 0.6;
  // Barycentric distance within which a foot between two triangles belongs to either. Sweep: nothing changes.
  double between = 1e-4;
  // Jacobian of the map to a foot, over that of the triangle, below which there is no foot: at 0 the point is a centre
  // of curvature. Sweep: nothing changes.
  double fold_over = 0.1;

  SIM_CORE_NAMED(reach, curvature_max, same_normal, beyond_edge, between, fold_over)
};

}  // namespace sim_core
