// Constants of collision-free motion.
#pragma once

namespace sim_core {

struct PathSettings {
  double keep = 0.5;
  double floor = 0.01;
  double advance = 0.9;
  double margin = 0.25;
  int rounds_max = 8;

  template <class Self, class Call>
  static void each(Self& s, const Call& call) {
    call("keep", s.keep);
    call("floor", s.floor);
    call("advance", s.advance);
    call("margin", s.margin);
    call("rounds_max", s.rounds_max);
  }
};

}  // namespace sim_core
