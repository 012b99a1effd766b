// Constants of motion without crossings.
#pragma once

#include "math/named.hpp"

namespace sim_core {

struct PathSettings {
  // Share that a motion leaves of the distance of a pair, or of h where that is less. Sweep: 0.25 takes 17 % more in a
  // fold and 38 % more in a pile, 0.75 takes 5 % more in a fold; 1 lets nothing approach.
  double keep = 0.5;
  // Distance, over h, below which nothing comes nearer: else many motions would bring a distance to rounding, and past
  // it. Sweep: results move by 1e-11 m.
  double floor = 0.01;
  // Share of a distance that one step of continuous collision detection leaves [Li et al. 2021, Algorithm 1, with their
  // s]. Sweep: within 5 % in a fold.
  double rest = 0.1;
  // Distance that nodes move before candidates are searched again, over the side of a cell: lists grow with it, and
  // searches with its inverse. Sweep: 0.125 and 0.5 take 3 and 5 % more in a fold.
  double margin = 0.25;
  // Rounds in which nodes are stopped one by one; after them all are stopped by the same share. Sweep: nothing changes.
  int rounds_max = 8;

  SIM_CORE_NAMED(keep, floor, rest, margin, rounds_max)
};

}  // namespace sim_core
