// Constants of halving steps.
#pragma once

namespace sim_core {

struct SteppingSettings {
  double loose = 0.1;
  double easy = 0.6;
  double near_patience = 2.5;
  int strained_soon = 2;
  int strained_long = 4;
  int smooth_iterations = 100;

  template <class Self, class Call>
  static void each(Self& s, const Call& call) {
    call("loose", s.loose);
    call("easy", s.easy);
    call("near_patience", s.near_patience);
    call("strained_soon", s.strained_soon);
    call("strained_long", s.strained_long);
    call("smooth_iterations", s.smooth_iterations);
  }
};

}  // namespace sim_core
