// Constants of contact.
//
// K is the stiffness of a node: its block on the diagonal of Newton's matrix without contact,
// mass/dt^2 included; that of a pair is 1/sum(w_i^2/K_i). h is the thickness. "Sweep" is the
// experiment of testing/src/stickslip_testing/constants.py, in which each constant is halved and
// doubled (benchmarks/results/solver- constants.json): percentages are iterations of Newton's
// method.
#pragma once

#include <algorithm>
#include <string>
#include <string_view>

namespace sim_core {

// Calls with each of the `names`, which are separated by commas, and its value.
template <class Call, class... Values>
void each_named(std::string_view names, const Call& call, Values&... values) {
  const auto next = [&] {
    const std::string name(names.substr(0, names.find(',')));
    names.remove_prefix(std::min(name.size() + 2, names.size()));
    return name;
  };
  (call(next(), values), ...);
}

// Within a struct: its members, in this order.
#define SIM_CORE_NAMED(...)                                \
  template <class Call>                                    \
  void each(const Call& call) {                            \
    sim_core::each_named(#__VA_ARGS__, call, __VA_ARGS__); \
  }

struct ContactSettings {
  // k/K, of the law of pairs, bodies and surfaces. k = K did not solve a sheet on an incline within
  // 60 s. Sweep: 0.05 takes 47 % more in a pile, 0.2 takes 62 % more on a ball.
  double law_stiffness = 0.1;
  // Stiffness of a node's contact in the factor, over K. With less, GMRES iterations of a dragged
  // cloth doubled or tripled; with more they grew by a tenth. Over law_stiffness it also bounds the
  // stiffness of turning friction: beyond, a node is as good as stuck.
  double penalty = 100.0;
  // Radius of the fillet of a corner between bodies, m: twice a usual thickness. A vertex has one
  // contact, and goes to and fro in a corner without one. Sweep: half and twice as much move a
  // valley by 1.1 and 0.5 mm, and take 23 and 37 % less.
  double fillet = 1e-3;
  // kappa/K and lambda/K. On an incline 100 took 76 iterations and 143 factors in place of 16
  // and 15. Sweep: 5 takes 83 % more on a ball, 20 takes 55 % more factors in a pile.
  double proximal = 10.0;
  // The same under the smoothed law, which regularizes redundant pairs by itself. Sweep: 500 takes
  // 18 % more in a crumple, 2000 takes 23 % more.
  double smooth_proximal = 1000.0;
  // Share of the mean of K that is added to n . K n, the stiffness along the normal. Cloth is much
  // stiffer in its plane than across it: with the mean alone, redundant pairs exchange large
  // forces. Sweep: 0.1 and 0.4 take 80 % more on a ball.
  double mean_share = 0.2;
  // The same in the second attempt at a step that failed: the whole mean. Sweep: 0.5 takes 9 % more
  // in a pile and 15 % less in a crumple, 2 takes 4 to 7 % less.
  double stiff_mean_share = 1.0;
  // Predicted gap below which an open pair closes, and gap up to which a pair resumes its force,
  // over h: more than curved cloth opens on straight predictions, less than is visible. Sweep: 0.01
  // takes 29 % more in a crumple, 0.04 takes 7 % more in a fold.
  double closing_gap = 0.02;
  // Squared sine of the angle of two edges, 6 degrees, from which they make a pair: the closest
  // points of parallel edges are not unique, and vertices bear there. Sweep: 0.005 and 0.02 take 17
  // and 6 % less in a pile, and move it by 2 um.
  double crossing_least = 0.01;
  // Share of the length of an edge, from its ends, within which it makes no pair: the vertex does.
  // Far above rounding, far below what moves a force. Sweep: within 18 %.
  double end_share = 1e-3;
  // Cosine of the angle of two normals, 60 degrees, up to which one pair takes the force of
  // another. Sweep: within 8 %; 1 transfers none.
  double match_cosine = 0.5;
  // Ratio of the violations of a pair in two iterations from which it stalls: where Newton's method
  // converges, it halves them at least. Sweep: 0.25 takes 22 % less in a crumple but 1 % more in a
  // fold, 1 takes 27 % more.
  double stall_ratio = 0.5;
  // Violation, in m, that counts as much as the tolerance of forces: 4e-6 h of cloth of 0.5 mm.
  // Sweep: within 8 %, but for the pile.
  double length_tolerance = 2e-9;
  // Violation up to which a pair stalls, over h: one that is further off has moved since its row
  // was made. Sweep: 0.25 takes 29 % more in a crumple, 1 changes nothing there.
  double stall_up_to = 0.5;
  // Factor by which the proximal stiffness of a pair that stalls grows. Sweep: 2 takes 11 % more in
  // a squeeze, 8 takes 3 % more in a fold.
  double penalty_growth = 4.0;
  // Bound of that growth: five growths. The stiffness of a pair is then 1e4 K, of which single
  // precision, with 1.7e7, keeps three digits. Sweep: 512 takes 29 % more in a crumple, 2048
  // changes nothing.
  double penalty_max = 1024.0;
  // Distance between the middles of two pairs, over h, within which they are one: their rows differ
  // by rounding, and they would exchange force. Those of neighbouring layers are 1 apart. Sweep:
  // 0.1 takes 9 to 12 % more in a pile and a fold, 0.4 takes 4 % more in a fold.
  double merge_radius = 0.2;
  // Distance between middles, over h, up to which the force of a pair that is gone goes to another:
  // half of that of neighbouring layers. Sweep: within 2 %.
  double transfer_radius = 0.5;
  // Distance, over h, up to which pieces make a pair, besides what they may have approached in the
  // step. Sweep: 2 takes 4 % more in a crumple and 3 % more on a ball, 8 takes 8 % more on a ball.
  double detection_range = 4.0;
  // Share of the mean thickness that pairs with surfaces keep: nodes keep all of it, and pairs
  // catch what sinks in between them. Sweep: results move by that distance, 0.06 to 0.13 mm in a
  // squeeze.
  double surface_share = 0.25;
  // Angle up to which the turn of a free node carries its slip, in rad; from twice that on it does
  // not. Cloth that turns by more in a step is stopped on its way, and its velocity is no guide.
  // Sweep: results move by 0.05 to 0.08 mm in a pile and a fold.
  double turn_max = 0.05;

  SIM_CORE_NAMED(law_stiffness, penalty, fillet, proximal, smooth_proximal, mean_share,
                 stiff_mean_share, closing_gap, crossing_least, end_share, match_cosine,
                 stall_ratio, length_tolerance, stall_up_to, penalty_growth, penalty_max,
                 merge_radius, transfer_radius, detection_range, surface_share, turn_max)
};

struct PathSettings {
  // Share that a motion leaves of the distance of a pair, or of h where that is less. Sweep: 0.25
  // takes 17 % more in a fold and 38 % more in a pile, 0.75 takes 5 % more in a fold; 1 lets
  // nothing approach.
  double keep = 0.5;
  // Distance, over h, below which nothing comes nearer: else many motions would bring a distance to
  // rounding, and past it. Sweep: results move by 1e-11 m.
  double floor = 0.01;
  // Share of a distance that one step of continuous collision detection leaves [Li et al. 2021,
  // Algorithm 1, with their s]. Sweep: within 5 % in a fold.
  double rest = 0.1;
  // Distance that nodes move before candidates are searched again, over the side of a cell: lists
  // grow with it, and searches with its inverse. Sweep: 0.125 and 0.5 take 3 and 5 % more in a
  // fold.
  double margin = 0.25;
  // Rounds in which nodes are stopped one by one; after them all are stopped by the same share.
  // Sweep: nothing changes.
  int rounds_max = 8;

  SIM_CORE_NAMED(keep, floor, rest, margin, rounds_max)
};

struct SmoothSettings {
  // Distance up to which nodes search for surfaces, over what they may come near in the step: more
  // than 1 for what contact deflects. Sweep: 0.75 misses contacts and takes 41 % more on a ball, 3
  // takes 2 % more.
  double reach = 1.5;
  // Bound of the curvature that counts, times the radius of a triangle's circle: a triangle sinks
  // by a quarter of that radius at most, and sharper surfaces poke through between nodes. Sweep:
  // 0.25 moves a sheet on a ball by 0.03 mm and takes 9 % more, 1 changes nothing.
  double curvature_max = 0.5;
  // Sine of the angle of the normals of the two sides of an edge below which they are one. Sweep:
  // nothing changes.
  double same_normal = 1e-3;
  // Barycentric distance beyond an edge at which the search for a foot goes on in the next
  // triangle. Sweep: nothing changes.
  double beyond_edge = 0.6;
  // Barycentric distance within which a foot between two triangles belongs to either. Sweep:
  // nothing changes.
  double between = 1e-4;
  // Jacobian of the map to a foot, over that of the triangle, below which there is no foot: at 0
  // the point is a centre of curvature. Sweep: nothing changes.
  double fold_over = 0.1;
  // Distance from a body, in m, within which pairs alone keep a node from surfaces, so that it does
  // not change between both from one iterate to the next. Sweep: 0.5 mm takes 59 % more and 2 mm 41
  // % less in a crumple between walls on a floor.
  double body_first = 1e-3;

  SIM_CORE_NAMED(reach, curvature_max, same_normal, beyond_edge, between, fold_over, body_first)
};

}  // namespace sim_core
