// Constants of stale factors.
#pragma once

#include "math/named.hpp"

namespace sim_core {

struct FactorSettings {
  // Nodes whose contacts differ from the factor's, over the pairs, from which parts are made anew. Sweep: 0.02 takes 20
  // % fewer factors and 9 % fewer GMRES iterations in a pile, 0.005 13 % fewer factors.
  double changed_share = 0.01;
  // Pairs that have no place in the pattern, over all, from which a new order is made. Sweep: within 5 % in a fold; an
  // order costs 12 ms at 1,941 vertices, and a factor 5 ms.
  double missing_share = 0.05;
  // Change of what holds a node, over the larger of both, that counts as another contact. Sweep: 0.25 takes 13 to 31 %
  // more factors, 1 takes 42 % more GMRES iterations in a fold.
  double hold_change = 0.5;
  // The same over the node's stiffness, below which it does not matter. Sweep: 0.2 takes 14 % more GMRES iterations in
  // a fold, 0.05 changes nothing.
  double hold_least = 0.1;
  // Factors that are kept, of the lengths of step that alternate. Sweep: within 3 %.
  int pool = 3;
  // Change of a triangle's bending stiffness, over it, from which the matrix of bending is assembled anew. Sweep: 0.06
  // takes 10 % more of a strip, 0.015 takes 4 to 8 % more of a pile and a crumple.
  double stiffening_change = 0.03;
  // Measure s of a fold (cloth/kernels/bending.hpp) from which its rank-two part of the matrix counts. Sweep: 0.005 and
  // 0.02 take up to 12 and 15 % more.
  double fold_smallest = 0.01;

  SIM_CORE_NAMED(changed_share, missing_share, hold_change, hold_least, pool, stiffening_change, fold_smallest)
};

}  // namespace sim_core
