// Constants of contact with smooth surfaces.
#pragma once

namespace sim_core {

struct SmoothSettings {
  double reach = 1.5;
  double curvature_max = 0.5;
  double same_normal = 1e-3;
  double beyond_edge = 0.6;
  double between = 1e-4;
  double fold_over = 0.1;

  template <class Self, class Call>
  static void each(Self& s, const Call& call) {
    call("reach", s.reach);
    call("curvature_max", s.curvature_max);
    call("same_normal", s.same_normal);
    call("beyond_edge", s.beyond_edge);
    call("between", s.between);
    call("fold_over", s.fold_over);
  }
};

}  // namespace sim_core
