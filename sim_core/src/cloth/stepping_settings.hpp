// Constants of steps that are halved.
#pragma once

#include "math/named.hpp"

namespace sim_core {

struct SteppingSettings {
  // Depth in a body, in m, from which a vertex is inside it: far above the gaps of solved steps, 1e-9 m, far below what
  // is visible.
  double inside = 1e-6;
  // Share of what makes stretching convex at the start of a step that lags in it: see kernels/membrane.hpp. Sweep: at
  // 0 navy-sparkle-sweat takes 2.3 times the iterations of a drag, at 4 12 % more, at 16 3 % less.
  double lag = 8.0;
  // Share of the patience up to which a step is easy, so that longer ones may follow. Sweep: 0.3 takes 24 % less and
  // 1.2 takes 17 % more in a crumple.
  double easy = 0.6;
  // Factor of the patience near other cloth, where halves of a step are hardly easier than the whole. Sweep: 1.25 takes
  // 27 % less and 5 takes 63 % more in a crumple; in a fold both take 6 % less.
  double near_patience = 2.5;
  // Strained iterations in a row, stopped short or with all rounds taken, after which an attempt that the controller
  // may halve at once is given up. Sweep: 1 takes twelve times as many where walls push, 4 takes 1 % less.
  int strained_soon = 2;
  // The same of an attempt for which halving comes last. Sweep: 2 takes 20 % more in a crumple, 8 takes 6 % more.
  int strained_long = 4;
  // Iterations of an attempt by way of the smoothed law. Sweep: 50 takes 9 % less and 200 takes 38 % more in a crumple.
  int smooth_iterations = 100;

  // Way of a vertex relative to a body that is no skeleton, over half the body's least extent, from which a step is
  // halved: what begins a step before a body must not be predicted behind its middle.
  double sweep = 0.5;

  SIM_CORE_NAMED(inside, lag, easy, near_patience, strained_soon, strained_long, smooth_iterations, sweep)
};

}  // namespace sim_core
