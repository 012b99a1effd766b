// Numbers by which the solver steps, and constants of the solver (see
// contact/settings.hpp).
#pragma once

#include <map>
#include <string>

#include "contact/settings.hpp"

namespace sim_core {

struct ClothSettings {
  double tolerance;  // N: largest residual force of a node
  int newton_max;    // iterations of Newton's method in a step
  double krylov_tolerance;
  int refactor_after;  // GMRES iterations that a stale factor may cost
  int patience;  // iterations of Newton's method after which a step is halved rather than pursued
  int halvings_max;  // of a step that does not converge
};

struct NewtonSettings {
  // Iterations after which a contact whose friction turns back is held. Sweep: 2 and 8 take 21 and
  // 17 % more in a crumple.
  int reversals_from = 4;
  // Changes of the active set of pairs in an iteration. Sweep: 3 takes 29 % more in a crumple, 12
  // changes nothing but on a ball.
  int rounds_max = 6;
  // Relative tolerance of GMRES with pairs, whose gaps it predicts: with 0.18 a sheet on an incline
  // took 956 iterations, with 1e-4 12. Sweep: 5e-5 takes 24 % and 2e-4 2 % more GMRES iterations in
  // a fold.
  double pairs_tolerance = 1e-4;
  // Absolute tolerance of GMRES over that of forces, so that a solved linear problem can end the
  // step. Sweep: 0.15 takes 14 % less in a crumple.
  double linear_share = 0.3;
  // Iterations whose largest residual bounds the next [Grippo et al. 1986]. Sweep: 2 takes 28 %
  // more in a crumple and 23 % more in a squeeze, 8 takes 6 to 7 % more.
  int window = 4;
  // Halvings of a correction along its line. Sweep: GMRES takes 18 % more with 2 and 4 % less with
  // 8 in a fold, and 15 % more with 5 in a pile.
  int cuts_max = 4;
  // Length of the first smoothing over h, and of each smoothing over the one before. Sweep: 0.05
  // and 0.2 take 21 and 20 % more in a crumple.
  double smoothing_ratio = 0.1;
  // Residual, over the mean force of smoothing, from which the law becomes sharper. Sweep: 2.5 and
  // 10 take 9 and 19 % more in a crumple.
  double smooth_near = 5.0;
  // Relative tolerance of GMRES under the smoothed law, whose matrix is the worse conditioned the
  // sharper it is. Sweep: 5e-7 and 2e-6 take 7 and 19 % more in a crumple.
  double smooth_tolerance = 1e-6;
  // Margins (path.margin) that a node may go in an iteration under the smoothed law, and hops of
  // its search. Sweep: 2 takes 5 % more and 8 takes 1 % less in a crumple.
  int smooth_hops = 4;
  // Hops of the search for candidates that a correction may take: farther away, nodes meet pairs
  // outside the list. Sweep: 2 takes 1 % more in a fold and a crumple.
  int hops = 1;
  // Decrease of the squares of forces that is slow for the matrix of a convex energy: Newton's
  // method with the exact one, which halves forces at least, takes its place. Sweep: 0.125 and 0.5
  // take 6 % more and 3 % less in a crumple.
  double slow = 0.25;
  // Decrease of the squares of forces, a hundredth of the forces, from which an attempt goes on
  // beyond its iterations, with the exact matrix. Sweep: half and twice take 3 and 14 % less in a
  // crumple.
  double nearly = 1e-4;
  // Iterations within which such an attempt halves the squares of forces. Sweep: 8 takes 2 to 3 %
  // less, 30 takes 1 to 9 % more.
  int halving_iterations = 15;
  // Times the iterations up to which it goes on. Sweep: 2 takes 42 % more in a pile, 8 changes
  // nothing.
  int longest = 4;
  // Share to which all nodes are shortened together before single ones are stopped, which strains
  // the cloth. Sweep: 0.05 and 0.2 take 20 and 8 % more in a crumple.
  double common_least = 0.1;

  SIM_CORE_NAMED(reversals_from, rounds_max, pairs_tolerance, linear_share, window, cuts_max,
                 smoothing_ratio, smooth_near, smooth_tolerance, smooth_hops, hops, slow, nearly,
                 halving_iterations, longest, common_least)
};

struct SteppingSettings {
  // Depth in a body, in m, from which a vertex is inside it: far above the gaps of solved steps,
  // 1e-9 m, far below what is visible.
  double inside = 1e-6;
  // Share of what makes stretching convex at the start of a step that lags in it: see
  // kernels/membrane.hpp. Sweep: at 0 navy-sparkle-sweat takes 2.3 times the iterations of a drag,
  // at 4 12 % more, at 16 3 % less.
  double lag = 8.0;
  // Share of the patience up to which a step is easy, so that longer ones may follow. Sweep: 0.3
  // takes 24 % less and 1.2 takes 17 % more in a crumple.
  double easy = 0.6;
  // Factor of the patience near other cloth, where halves of a step are hardly easier than the
  // whole. Sweep: 1.25 takes 27 % less and 5 takes 63 % more in a crumple; in a fold both take 6 %
  // less.
  double near_patience = 2.5;
  // Strained iterations in a row, stopped short or with all rounds taken, after which an attempt
  // that the controller may halve at once is given up. Sweep: 1 takes 19 times as many where walls
  // push, 4 takes 1 % less.
  int stalled_soon = 2;
  // The same of an attempt for which halving comes last. Sweep: 2 takes 20 % more in a crumple, 8
  // takes 6 % more.
  int stalled_long = 4;
  // Iterations of an attempt by way of the smoothed law. Sweep: 50 takes 9 % less and 200 takes 38
  // % more in a crumple.
  int smooth_iterations = 100;

  // Way of a vertex relative to a body, over half the body's least extent,
  // from which a step is halved: what begins a step before a body must not be predicted behind its
  // middle.
  double sweep = 0.5;

  SIM_CORE_NAMED(inside, lag, easy, near_patience, stalled_soon, stalled_long, smooth_iterations,
                 sweep)
};

struct ControlSettings {
  // Estimate of the error, over the allowed one, from which a step is taken back. Sweep: 1 takes 16
  // to 30 % more of a strip, 4 takes 5 % less.
  double reject_at = 2.0;
  // The same up to which steps grow: twice the step makes four times the error, and 4 x 0.3 stays
  // well below 2. Sweep: within 10 %.
  double grow_at = 0.3;
  // Cost of a factor in iterations of GMRES: 18 at 81 x 81 vertices, 12 at 41 x 41, 11 at 21 x 21,
  // less where parts are made. Sweep: within 3 %.
  double factor_work = 9.0;
  // Cost of an evaluation in iterations of GMRES: 1.0 at 41 x 41 vertices, 3 at 21 x 21. Sweep:
  // within 2 %.
  double newton_work = 1.5;
  // Work of a rejected step over that of an accepted one: the attempt, and the prediction that it
  // spoils. Sweep: 1 takes 2 % less and 4 takes 6 % more of a strip.
  double rejected_work = 2.0;
  // Ratio of costs per time from which longer steps are given up. Sweep: 0.55 takes 8 to 30 % more
  // of a strip, 2.2 takes 2 % less.
  double dearer = 1.1;
  // Share of their cost that coarser levels are forgiven with each step, so that they are tried
  // again: half after 34 steps. Sweep: 0.01 takes 9 % more of a strip.
  double forgiven = 0.02;
  // Weight of the last step in the mean cost of its level: that of three steps. Sweep: within 6 %.
  double novelty = 0.3;
  // Halvings of a step that is not solved beyond `finest`. Without any, royal-target dragged for 24
  // s at mu 0.8 cost 24.8 CPU s in place of 14.5. Sweep: 2 takes 1 % more iterations and 3 % more
  // factors of a fold that is let down.
  int halvings = 4;
  // Times in the longest step at which bodies and holders are looked at: one in each of the
  // shortest of `certified`.
  int looks = 64;

  SIM_CORE_NAMED(reject_at, grow_at, factor_work, newton_work, rejected_work, dearer, forgiven,
                 novelty, halvings, looks)
};

struct FactorSettings {
  // Nodes whose contacts differ from the factor's, over the pairs, from which parts are made anew.
  // Sweep: 0.02 takes 20 % fewer factors and 9 % fewer GMRES iterations in a pile, 0.005 13 % fewer
  // factors.
  double changed_share = 0.01;
  // Pairs that have no place in the pattern, over all, from which a new order is made. Sweep:
  // within 5 % in a fold; an order costs 12 ms at 1,941 vertices, and a factor 5 ms.
  double missing_share = 0.05;
  // Change of what holds a node, over the larger of both, that counts as another contact. Sweep:
  // 0.25 takes 13 to 31 % more factors, 1 takes 42 % more GMRES iterations in a fold.
  double hold_change = 0.5;
  // The same over the node's stiffness, below which it does not matter. Sweep: 0.2 takes 14 % more
  // GMRES iterations in a fold, 0.05 changes nothing.
  double hold_least = 0.1;
  // Factors that are kept, of the lengths of step that alternate. Sweep: within 3 %.
  int pool = 3;
  // Change of a triangle's bending stiffness, over it, from which the matrix of bending is
  // assembled anew. Sweep: 0.06 takes 10 % more of a strip, 0.015 takes 4 to 8 % more of a pile and
  // a crumple.
  double stiffening_change = 0.03;
  // Measure s of a fold (cloth/kernels/bending.hpp) from which its rank-two part of the matrix
  // counts. Sweep: 0.005 and 0.02 take up to 12 and 15 % more.
  double fold_smallest = 0.01;

  SIM_CORE_NAMED(changed_share, missing_share, hold_change, hold_least, pool, stiffening_change,
                 fold_smallest)
};

struct Constants {
  ContactSettings contact;
  PathSettings path;
  SmoothSettings smooth;
  NewtonSettings newton;
  SteppingSettings stepping;
  ControlSettings control;
  FactorSettings factor;

  SIM_CORE_NAMED(contact, path, smooth, newton, stepping, control, factor)

  Constants() = default;
  // Replaces those named "group.name". Throws std::invalid_argument if there is none of that name,
  // or where a value is not above 0, or not an integer >= 1 for a count.
  explicit Constants(const std::map<std::string, double>& changed);
  std::map<std::string, double> by_name() const;
};

}  // namespace sim_core
