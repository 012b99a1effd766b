// Constants of contact between pairs of closest points.
#pragma once

namespace sim_core {

struct ContactSettings {
  double law_stiffness = 0.1;
  double proximal = 10.0;
  double smooth_proximal = 1000.0;
  double mean_share = 0.2;
  double stiff_mean_share = 1.0;
  double closing_gap = 0.02;
  double crossing_least = 0.01;
  double end_share = 1e-3;
  double match_cosine = 0.5;
  double stall_ratio = 0.5;
  double length_tolerance = 2e-9;
  double stall_up_to = 0.5;
  double penalty_growth = 4.0;
  double penalty_max = 1024.0;
  double merge_radius = 0.2;
  double transfer_radius = 0.5;
  double detection_range = 2.0;
  double surface_share = 0.25;
  double turn_max = 0.05;

  template <class Self, class Call>
  static void each(Self& s, const Call& call) {
    call("law_stiffness", s.law_stiffness);
    call("proximal", s.proximal);
    call("smooth_proximal", s.smooth_proximal);
    call("mean_share", s.mean_share);
    call("stiff_mean_share", s.stiff_mean_share);
    call("closing_gap", s.closing_gap);
    call("crossing_least", s.crossing_least);
    call("end_share", s.end_share);
    call("match_cosine", s.match_cosine);
    call("stall_ratio", s.stall_ratio);
    call("length_tolerance", s.length_tolerance);
    call("stall_up_to", s.stall_up_to);
    call("penalty_growth", s.penalty_growth);
    call("penalty_max", s.penalty_max);
    call("merge_radius", s.merge_radius);
    call("transfer_radius", s.transfer_radius);
    call("detection_range", s.detection_range);
    call("surface_share", s.surface_share);
    call("turn_max", s.turn_max);
  }
};

}  // namespace sim_core
