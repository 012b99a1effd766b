// Constants of the stale factors.
#pragma once

namespace sim_core {

struct FactorSettings {
  double changed_share = 0.01;
  double missing_share = 0.05;
  double hold_change = 0.5;
  double hold_least = 0.1;
  int pool = 3;
  double stiffening_change = 0.03;
  double fold_smallest = 0.01;

  template <class Self, class Call>
  static void each(Self& s, const Call& call) {
    call("changed_share", s.changed_share);
    call("missing_share", s.missing_share);
    call("hold_change", s.hold_change);
    call("hold_least", s.hold_least);
    call("pool", s.pool);
    call("stiffening_change", s.stiffening_change);
    call("fold_smallest", s.fold_smallest);
  }
};

}  // namespace sim_core
