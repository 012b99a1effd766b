// Constants of Newton's method.
#pragma once

namespace sim_core {

struct NewtonSettings {
  int reversals_from = 4;
  int rounds_max = 6;
  double pairs_tolerance = 1e-4;
  double linear_share = 0.3;
  int window = 4;
  int cuts_max = 5;
  double last_growth = 1e4;
  double smoothing_ratio = 0.1;
  double smooth_near = 5.0;
  double smooth_tolerance = 1e-6;
  int smooth_hops = 4;
  int hops = 1;
  double slow = 0.25;
  double nearly = 1e-4;
  int halving_iterations = 15;
  int longest = 4;
  double diverged = 1e8;
  double common_least = 0.1;

  template <class Self, class Call>
  static void each(Self& s, const Call& call) {
    call("reversals_from", s.reversals_from);
    call("rounds_max", s.rounds_max);
    call("pairs_tolerance", s.pairs_tolerance);
    call("linear_share", s.linear_share);
    call("window", s.window);
    call("cuts_max", s.cuts_max);
    call("last_growth", s.last_growth);
    call("smoothing_ratio", s.smoothing_ratio);
    call("smooth_near", s.smooth_near);
    call("smooth_tolerance", s.smooth_tolerance);
    call("smooth_hops", s.smooth_hops);
    call("hops", s.hops);
    call("slow", s.slow);
    call("nearly", s.nearly);
    call("halving_iterations", s.halving_iterations);
    call("longest", s.longest);
    call("diverged", s.diverged);
    call("common_least", s.common_least);
  }
};

}  // namespace sim_core
