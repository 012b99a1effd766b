// Constants of contact of nodes with bodies.
#pragma once

#include "math/named.hpp"

namespace sim_core {

struct NodeSettings {
  // Stiffness of a contact in the factor over that of the node. With less, GMRES iterations of a dragged cloth doubled
  // or tripled; with more they grew by a tenth. Over law_stiffness it also bounds the stiffness of turning friction:
  // beyond, a node is as good as stuck.
  double penalty = 100.0;
  // Distance from a body, in m, within which a node that begins a step there touches surfaces by pairs only, so that it
  // does not change between body and surface from one iterate to the next. Sweep: 0.5 mm takes 59 % more and 2 mm 41 %
  // less in a crumple between walls on a floor.
  double body_first = 1e-3;

  SIM_CORE_NAMED(penalty, body_first)
};

}  // namespace sim_core
