// Constants of skeletons.
#pragma once

#include "math/named.hpp"

namespace sim_core {

struct SkeletonSettings {
  // Radius over the side of a cell below which a body has a skeleton. From there on vertices suffice: a triangle
  // between them sinks by a sixteenth of a cell at most.
  double radius_max = 2.0;
  // Half of the shortest edge of a box over the side of a cell below which its skeleton is all that cloth feels: it
  // then has faces, too, which cost more than those that vertices touch, but nothing jumps over it.
  double thickness_max = 2.0;
  // Distance over the diameter of the cloth at rest by which an endless body reaches beyond the cloth.
  double beyond = 2.0;

  SIM_CORE_NAMED(radius_max, thickness_max, beyond)
};

}  // namespace sim_core
