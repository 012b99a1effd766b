// Constants of the choice of step sizes.
#pragma once

namespace sim_core {

struct ControlSettings {
  double reject_at = 2.0;
  double grow_at = 0.3;
  double factor_work = 9.0;
  double newton_work = 1.5;
  double rejected_work = 2.0;
  double dearer = 1.1;
  double forgiven = 0.02;
  double novelty = 0.3;
  int halvings = 2;
  int halvings_near = 4;

  template <class Self, class Call>
  static void each(Self& s, const Call& call) {
    call("reject_at", s.reject_at);
    call("grow_at", s.grow_at);
    call("factor_work", s.factor_work);
    call("newton_work", s.newton_work);
    call("rejected_work", s.rejected_work);
    call("dearer", s.dearer);
    call("forgiven", s.forgiven);
    call("novelty", s.novelty);
    call("halvings", s.halvings);
    call("halvings_near", s.halvings_near);
  }
};

}  // namespace sim_core
