// The balance of momentum of a step.
#include "cloth/stepping.hpp"

namespace sim_core {

// Of the part of a step that was taken: the sums of M a and of -c M v over all nodes.
//
// Second order takes its acceleration over two steps, v1 = a1 v0 + a2 v_before + h a, so a is no
// change of velocity over the last step. It is in the target: M rate (x1 - target) = M (a - g).
void Stepper::sum_momentum(const BoundaryConditions& drive) {
  const Numbering& numbering = assembly_.numbering;
  momentum_rate_.setZero();
  damping_force_.setZero();
  for (int i = 0; i < numbering.nodes; ++i) {
    const double mass = assembly_.mass[i];
    const double viscous = (drive.damping + assembly_.own_damping[i]) / inertia_.span[i];
    damping_force_ -= mass * viscous * (at_node(x, i) - at_node(inertia_.origin, i));
    if (inertia_.scheme[i] == Scheme::second_order) {
      momentum_rate_ += mass * inertia_.rate[i] * (at_node(x, i) - at_node(inertia_.target, i));
    } else {
      momentum_rate_ += mass * at_node(velocities.acceleration(), i);
    }
  }
  for (int v = 0; v < numbering.vertices; ++v) {
    const int node = numbering.node[v];
    if (inertia_.scheme[node] != Scheme::second_order) continue;
    momentum_rate_ += assembly_.mass[node] * drive.gravity.row(v).transpose();
  }
}

}  // namespace sim_core
