// Constants of contact: numbers on which results or costs depend. A number that only guards against
// rounding or endless loops stands beside its use.
//
// K is the stiffness of a node: its block on the diagonal of Newton's matrix without contact,
// mass/dt^2 included; that of a pair is 1/sum(w_i^2/K_i). h is the thickness. Numbers without a
// unit are ratios. "Sweep": the constant was halved and doubled in the scenes of
// testing/src/stickslip_testing/contact_scenes.py; percentages are iterations of Newton's method.
#pragma once

namespace sim_core {

// An order of magnitude: the ratio from which one number is much larger than another.
constexpr double much = 10.0;

// Stiffnesses of a contact.
namespace stiffness {

// k/K, of the law of pairs, bodies and surfaces. k = K did not solve a sheet on an incline within
// 60 s. Sweep: 0.05 takes 47 % more in a pile, 0.2 takes 62 % more on a ball.
constexpr double law = 1.0 / much;
// kappa/K and lambda/K. On an incline 100 took 76 iterations and 143 factors in place of 16 and 15.
// Sweep: 5 takes 83 % more on a ball, 20 takes 55 % more factors in a pile.
constexpr double proximal = much;
// Stiffness of a node's contact in the factor, over K. With less, GMRES iterations of a dragged
// cloth doubled or tripled; with more they grew by a tenth.
constexpr double factor = much * much;
// Stiffness of friction against a turn of its direction, over k: beyond, a node is as good as
// stuck.
constexpr double turn_stiffness_max = factor / law;
// kappa/K and lambda/K under the smoothed law, which regularizes redundant pairs by itself. Sweep:
// 500 takes 18 % more in a crumple, 2000 takes 23 % more.
constexpr double smoothed_proximal = much * much * much;

// Share of the mean of K that is added to n . K n, the stiffness along the normal. Cloth is much
// stiffer in its plane than across it: with the mean alone, redundant pairs exchange large forces.
// Sweep: 0.1 and 0.4 take 80 % more on a ball.
constexpr double mean_fraction = 0.2;

// Factor by which the proximal stiffness of a pair that stalls grows. Sweep: 2 takes 11 % more in a
// squeeze, 8 takes 3 % more in a fold.
constexpr double growth = 4.0;
// Bound of that growth, 1024: five growths. The stiffness of a pair is then 1e4 K, of which single
// precision, with 1.7e7, keeps three digits. Sweep: 512 takes 29 % more in a crumple, 2048 changes
// nothing.
constexpr double growth_max = growth * growth * growth * growth * growth;

}  // namespace stiffness

// Pairs of closest points.
namespace pairs {

// Ratio of the forces, or of the violations of a pair, in two iterations below which Newton's
// method converges. Sweep, of pairs: 0.25 takes 22 % less in a crumple but 1 % more in a fold, 1
// takes 27 % more.
constexpr double converging = 0.5;
// Predicted gap below which an open pair closes, and gap up to which a pair resumes its force, over
// h: more than curved cloth opens on straight predictions, less than is visible. Sweep: 0.01 takes
// 29 % more in a crumple, 0.04 takes 7 % more in a fold.
constexpr double closing_gap = 0.02;
// Squared sine of the angle of two edges from which they make a pair: they go much more along each
// other than across below 6 degrees. The closest points of parallel edges are not unique, and
// vertices bear there. Sweep: 0.005 and 0.02 take 17 and 6 % less in a pile, and move it by 2 um.
constexpr double crossing_min = 1.0 / (much * much);
// Cosine of the angle of two normals, 60 degrees, up to which one pair takes the force of another.
// Sweep: within 8 %; 1 transfers none.
constexpr double match_cosine = 0.5;
// Violation, in m, that counts as much as the tolerance of forces: 4e-6 h of cloth of 0.5 mm.
// Sweep: within 8 %, but for the pile.
constexpr double length_tolerance = 2e-9;
// Distance, over h: half of that of neighbouring layers. Up to it a pair stalls, for one that
// violates its law by more has moved since its row was made, and the force of a pair that is gone
// goes to another. Sweep: 0.25 takes 29 % more in a crumple, 1 changes nothing there.
constexpr double half_layer = 0.5;
// Distance between the middles of two pairs, over h, within which they are one: their rows differ
// by rounding, and they would exchange force. Those of neighbouring layers are 1 apart. Sweep: 0.1
// takes 9 to 12 % more in a pile and a fold, 0.4 takes 4 % more in a fold.
constexpr double merge_radius = 0.2;
// Distance, over h, up to which pieces make a pair, besides what they may have approached in the
// step. Sweep: 2 takes 4 % more in a crumple and 3 % more on a ball, 8 takes 8 % more on a ball.
constexpr double detection_range = 4.0;
// Share of the mean thickness that pairs with surfaces keep: nodes keep all of it, and pairs catch
// what sinks in between them. Sweep: results move by that distance, 0.06 to 0.13 mm in a squeeze.
constexpr double surface_fraction = 0.25;
// Angle up to which the turn of a free node carries its slip, in rad; from twice that on it does
// not. Cloth that turns by more in a step is stopped on its way, and its velocity is no guide.
// Sweep: results move by 0.05 to 0.08 mm in a pile and a fold.
constexpr double turn_max = 0.05;

}  // namespace pairs

// What a motion may leave of distances, and how far it may go.
namespace path {

// Share that a motion leaves of the distance of a pair, or of h where that is less. Sweep: 0.25
// takes 17 % more in a fold and 38 % more in a pile, 0.75 takes 5 % more in a fold; 1 lets nothing
// approach.
constexpr double distance_fraction = 0.5;
// Distance, over h, below which nothing comes nearer: what a motion leaves of the gap at which
// pairs close. Without it many motions would bring a distance to rounding, and past it. Sweep:
// results move by 1e-11 m.
constexpr double distance_min = distance_fraction * pairs::closing_gap;
// Distance that nodes move before candidates are searched again, over the side of a cell: lists
// grow with it, and searches with its inverse. Sweep: 0.125 and 0.5 take 3 and 5 % more in a fold.
constexpr double skin = 0.25;

}  // namespace path

// Bodies, and surfaces of triangles.
namespace obstacles {

// Radius of the fillet of a corner between bodies, m: twice a usual thickness. A vertex has one
// contact, and goes to and fro in a corner without one. In a corner of a body and a surface, pairs
// alone keep a node from the surface within this distance of the body, so that it does not change
// between both from one iterate to the next. Sweep: half and twice as much move a valley of bodies
// by 1.1 and 0.5 mm, and take 23 and 37 % less; in a crumple between walls on a floor they take 59
// % more and 41 % less.
constexpr double corner = 1e-3;
// Distance up to which nodes search for surfaces, over what they may come near in the step: more
// than 1 for what contact deflects. Sweep: 0.75 misses contacts and takes 41 % more on a ball, 3
// takes 2 % more.
constexpr double reach = 1.5;
// Bound of the curvature that counts, times the radius of a triangle's circle: a triangle sinks by
// a quarter of that radius at most, and sharper surfaces poke through between nodes. Sweep: 0.25
// moves a sheet on a ball by 0.03 mm and takes 9 % more, 1 changes nothing.
constexpr double curvature_max = 0.5;

}  // namespace obstacles

}  // namespace sim_core
