// Constants of steps, Newton's method and factors: see contact/constants.hpp, which has the words.
#pragma once

#include "contact/constants.hpp"

namespace sim_core {

// Newton's method, newton.cpp and linear_solver.cpp.
namespace newton {

// Changes of the active set of pairs in an iteration. Sweep: 3 takes 29 % more in a crumple, 12
// changes nothing but on a ball.
constexpr int rounds_max = 6;
// Relative tolerance of GMRES with pairs, whose gaps it predicts: with 0.18 a sheet on an incline
// took 956 iterations, with 1e-4 12. Sweep: 5e-5 takes 24 % and 2e-4 2 % more GMRES iterations in a
// fold.
constexpr double pairs_tolerance = 1e-4;
// Absolute tolerance of GMRES over that of forces, so that a solved linear problem can end the
// step. Sweep: 0.15 takes 14 % less in a crumple.
constexpr double linear_fraction = 0.3;
// Iterations that count as the last ones: their largest residual bounds the next [Grippo et al.
// 1986], and after so many a contact whose friction turns back is held. Sweep, of the bound: 2
// takes 28 % more in a crumple and 23 % more in a squeeze, 8 takes 6 to 7 % more; of the hold: 2
// and 8 take 21 and 17 % more in a crumple.
constexpr int window = 4;
// Halvings of a correction along its line. Sweep: GMRES takes 18 % more with 2 and 4 % less with 8
// in a fold, and 15 % more with 5 in a pile.
constexpr int cuts_max = 4;
// Length of the first smoothing over h, and of each smoothing over the one before: each is much
// sharper. Sweep: 0.05 and 0.2 take 21 and 20 % more in a crumple.
constexpr double smoothing_ratio = 1.0 / much;
// Residual, over the mean force of smoothing, from which the law becomes sharper: it is not much
// larger yet. Sweep: 2.5 and 10 take 9 and 19 % more in a crumple.
constexpr double smoothed_residual = 0.5 * much;
// Relative tolerance of GMRES under the smoothed law, whose matrix is the worse conditioned the
// stiffer its proximal terms are. Sweep: 5e-7 and 2e-6 take 7 and 19 % more in a crumple.
constexpr double smoothed_tolerance =
    pairs_tolerance * stiffness::proximal / stiffness::smoothed_proximal;
// Skins that a node may go in an iteration under the smoothed law: the side of a cell. Sweep: 2
// takes 5 % more and 8 takes 1 % less in a crumple.
constexpr int smoothed_hops = static_cast<int>(1.0 / path::skin);
// Decrease of the squares of forces from which the matrix of a convex energy is slow: Newton's
// method with the exact one takes its place. Sweep: 0.125 and 0.5 take 6 % more and 3 % less in a
// crumple.
constexpr double slow = pairs::converging * pairs::converging;
// Decrease of the squares of forces from which an attempt goes on beyond its iterations, with the
// exact matrix: two orders of magnitude of the forces. Sweep: half and twice take 3 and 14 % less
// in a crumple.
constexpr double close = 1.0 / (much * much * much * much);
// Share to which all nodes are shortened together before single ones are stopped, which strains the
// cloth: all go much less far. Sweep: 0.05 and 0.2 take 20 and 8 % more in a crumple.
constexpr double common_min = 1.0 / much;

}  // namespace newton

// Steps and the fallback ladder, stepping.cpp.
namespace stepping {

// Share of what makes stretching convex at the start of a step that lags in it: see
// kernels/membrane.hpp. Sweep: at 0 navy-sparkle-sweat takes 2.3 times the iterations of a drag, at
// 4 12 % more, at 16 3 % less.
constexpr double lag = 8.0;
// Share of the allowed iterations, or error, up to which a step is cheap, so that longer ones may
// follow. Sweep: 0.3 takes 24 % less and 1.2 takes 17 % more in a crumple.
constexpr double cheap = 0.6;
// Factor of a step's iterations near other cloth, where halves of a step are hardly easier than the
// whole. Sweep: 1.25 takes 27 % less and 5 takes 63 % more in a crumple; in a fold both take 6 %
// less.
constexpr double near_factor = 2.5;
// Iterations in a row, stopped short or with all rounds taken, after which an attempt that the
// controller may halve at once is given up. Sweep: 1 takes 19 times as many where walls push, 4
// takes 1 % less.
constexpr int stalled_soon = 2;
// The same of an attempt for which halving comes last: twice as many. Sweep: 2 takes 20 % more in a
// crumple, 8 takes 6 % more.
constexpr int stalled_late = 2 * stalled_soon;
// Way of a vertex relative to a body, over half the body's least extent, from which a step is
// halved. What begins a step before a body must not be predicted behind its middle: it leaves as
// much of that way as other motions do.
constexpr double tunnel_fraction = 1.0 - path::distance_fraction;

// Weight of the error of nodes of second order. Their errors add up to phases, as nothing damps
// them: a strip that swings for 2 s is then as far off at its tip as its steps are allowed, ten
// times over.
constexpr double second_order_weight = 4.0;

}  // namespace stepping

// Lengths of steps, control.cpp.
namespace control {

// Estimate of the error, over the allowed one, from which a step is taken back. Sweep: 1 takes 16
// to 30 % more of a strip, 4 takes 5 % less.
constexpr double reject_at = 2.0;
// The same up to which steps grow: twice the step makes four times the error, which must be cheap
// then. Sweep: within 10 %.
constexpr double grow_at = stepping::cheap * reject_at / 4.0;
// Cost of a factor in iterations of GMRES: 18 at 81 x 81 vertices, 12 at 41 x 41, 11 at 21 x 21,
// less where parts are made. Sweep: within 3 %.
constexpr double factor_work = 9.0;
// Cost of an evaluation in iterations of GMRES: 1.0 at 41 x 41 vertices, 3 at 21 x 21. Sweep:
// within 2 %.
constexpr double newton_work = 1.5;
// Work of a rejected step over that of an accepted one: the attempt, and the prediction that it
// spoils. Sweep: 1 takes 2 % less and 4 takes 6 % more of a strip.
constexpr double rejected_work = 2.0;
// Ratio of costs per time from which longer steps are given up. Sweep: 0.55 takes 8 to 30 % more of
// a strip, 2.2 takes 2 % less.
constexpr double dearer = 1.1;
// Share of their cost that coarser levels are forgiven with each step, so that they are tried
// again: half after 34 steps. Sweep: 0.01 takes 9 % more of a strip.
constexpr double forgiven = 0.02;
// Weight of the last step in the mean cost of its level: that of three steps. Sweep: within 6 %.
constexpr double novelty = 0.3;
// Velocity by which friction that turns may be wrong, times the longest step, over the allowed
// error, from which a step is taken back: a quarter of what one error may be, because it adds up
// over the turns of a body that shakes. At 2.0 a patch on a floor that is shaken at 24 to 60 Hz is
// 1.1 times as far off.
constexpr double turned_at = reject_at / 4.0;
// Halvings of a step that is not solved beyond `finest`. Without any, royal-target dragged for 24 s
// at mu 0.8 cost 24.8 CPU s in place of 14.5. Sweep: 2 takes 1 % more iterations and 3 % more
// factors of a fold that is let down.
constexpr int halvings = 4;
// Iterations of Newton's method, with those of rejected tries, after which a step is given up and
// the run fails the check `budget`. Cloth that is pushed, squeezed or let down takes 37 at most,
// and cloth on a peg took 402. A napkin between walls took 212 before it had no room left, and
// 7,388 in the step after. It is 5 CPU s of 41 x 41 vertices in contact.
constexpr int iterations_max = 1000;
// Times in the longest step at which bodies and holders are sampled: one in each of the shortest of
// `certified`.
constexpr int samples = 64;

}  // namespace control

// Supports that gain speed faster than friction gives it to cloth, followed_slip.cpp,
// friction_turns.cpp and control.cpp. The numbers were chosen on some hundred runs of a patch on
// floors of 12 to 70 Hz, 0.5 to 4 mm and mu 0.2 to 1.2, and judged on 120 others: docs/cloth.md.
namespace shaken {

// Rate at which a support gains speed, m/s^2, up to which it is taken to move evenly: a hundredth
// of g, which friction follows at any coefficient that matters.
constexpr double even_gain = 0.1;
// Equal parts of a step in which the velocity of a support is looked at: in the longest step, each
// has four samples.
constexpr int parts = control::samples / 4;
// Rate at which a support gains speed, over the most that friction gives to cloth, from which slip
// is followed. Below, what sticks keeps sticking, and what slides does not turn.
constexpr double followed_from = 0.5;
// Errors of place that add up, over the turns of a support in a second: a floor of 15 Hz turns as
// often. With 10, patches were clearly further off.
constexpr double turns_that_add_up = 30.0;
// Longest steps for which cloth keeps the velocity at which its support set it off: half a second
// with `certified`. With 1, patches were further off.
constexpr double lasting = 4.0;
// Change of a support's acceleration from one part to the next, over the larger, from which it is
// set off between them: the same share. A 70 Hz sine stays far below it where it is fast.
constexpr double set_off = followed_from;

}  // namespace shaken

// Factors as preconditioners, pair_factor.cpp and assembly.cpp.
namespace factors {

// Nodes whose contacts differ from the factor's, over the pairs, from which parts are made anew.
// Sweep: 0.02 takes 20 % fewer factors and 9 % fewer GMRES iterations in a pile, 0.005 13 % fewer
// factors.
constexpr double changed_fraction = 0.01;
// Pairs that have no place in the pattern, over all, from which a new order is made. Sweep: within
// 5 % in a fold; an order costs 12 ms at 1,941 vertices, and a factor 5 ms.
constexpr double missing_fraction = 0.05;
// Change of what holds a node, over the larger of both, that counts as another contact. Sweep: 0.25
// takes 13 to 31 % more factors, 1 takes 42 % more GMRES iterations in a fold.
constexpr double hold_change = 0.5;
// The same over the node's stiffness, below which it does not matter: a contact as its law has it.
// Sweep: 0.2 takes 14 % more GMRES iterations in a fold, 0.05 changes nothing.
constexpr double hold_min = stiffness::law;
// Change of a triangle's bending stiffness, over it, from which the matrix of bending is assembled
// anew. Sweep: 0.06 takes 10 % more of a strip, 0.015 takes 4 to 8 % more of a pile and a crumple.
constexpr double stiffening_change = 0.03;
// Measure s of a fold (cloth/kernels/bending.hpp) from which its rank-two part of the matrix
// counts. Sweep: 0.005 and 0.02 take up to 12 and 15 % more.
constexpr double fold_min = 0.01;

}  // namespace factors

}  // namespace sim_core
