// Constants of contact between nodes and bodies.
#pragma once

namespace sim_core {

struct NodeSettings {
  double penalty = 100.0;
  double body_first = 1e-3;

  template <class Self, class Call>
  static void each(Self& s, const Call& call) {
    call("penalty", s.penalty);
    call("body_first", s.body_first);
  }
};

}  // namespace sim_core
