// Constants of the choice of step sizes.
#pragma once

#include "math/named.hpp"

namespace sim_core {

struct ControlSettings {
  // Estimate of the error, over the allowed one, from which a step is taken back. Sweep: 1 takes 16 to 30 % more of a
  // strip, 4 takes 5 % less.
  double reject_at = 2.0;
  // The same up to which steps grow: twice the step makes four times the error, and 4 x 0.3 stays well below 2. Sweep:
  // within 10 %.
  double grow_at = 0.3;
  // Cost of a factor in iterations of GMRES: 12 at 6,561 and 41 x 41 vertices, 11 at 21 x 21, less where parts are
  // made. Sweep: within 3 %.
  double factor_work = 9.0;
  // Cost of an evaluation in iterations of GMRES: 1.0 at 41 x 41 vertices, 3 at 21 x 21. Sweep: within 2 %.
  double newton_work = 1.5;
  // Work of a rejected step over that of an accepted one: the attempt, and the prediction that it spoils. Sweep: 1
  // takes 2 % less and 4 takes 6 % more of a strip.
  double rejected_work = 2.0;
  // Ratio of costs per time from which longer steps are given up. Sweep: 0.55 takes 8 to 30 % more of a strip, 2.2
  // takes 2 % less.
  double dearer = 1.1;
  // Share of their cost that coarser levels are forgiven with each step, so that they are tried again: half after 34
  // steps. Sweep: 0.01 takes 9 % more of a strip.
  double forgiven = 0.02;
  // Weight of the last step in the mean cost of its level: that of three steps. Sweep: within 6 %.
  double novelty = 0.3;
  // Halvings of a step that is not solved beyond `finest`. Without any, royal-target dragged for 24 s at mu 0.8 cost
  // 24.8 CPU s in place of 14.5. Sweep: 2 takes 1 % more iterations and 3 % more factors of a fold that is let down.
  int halvings = 4;
  // Times in the longest step at which bodies and holders are looked at: one in each of the shortest of `certified`.
  int looks = 64;

  SIM_CORE_NAMED(reject_at, grow_at, factor_work, newton_work, rejected_work, dearer, forgiven, novelty, halvings,
                 looks)
};

}  // namespace sim_core
