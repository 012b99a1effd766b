// Worst values over the accepted steps, which the checks of a run judge, see checks.py.
#pragma once

#include <algorithm>

namespace sim_core {

struct Observed {
  double stretch = 0.0;       // largest principal stretch of a triangle at the end of a step
  double depth = 0.0;         // largest depth in a body at the end of a step beyond what round bodies allow, cells
  int passages = 0;           // triangles that passed the core of a body
  double contact_work = 0.0;  // J: of bodies on the cloth as it moves against them, where that is positive
  double flow = 0.0;          // J: sum of the sizes of all changes of energy and of all work
  double balance = 0.0;       // J: energy gained beyond the work of all forces
  double gain = 0.0;          // J: the largest `balance` at the end of a step

  void add(const Observed& next) {
    stretch = std::max(stretch, next.stretch);
    depth = std::max(depth, next.depth);
    passages += next.passages;
    contact_work += next.contact_work;
    flow += next.flow;
    gain = std::max(gain, balance + next.gain);
    balance += next.balance;
  }
};

}  // namespace sim_core
