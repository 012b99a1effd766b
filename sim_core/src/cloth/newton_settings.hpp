// Constants of Newton's method.
#pragma once

#include "math/named.hpp"

namespace sim_core {

struct NewtonSettings {
  // Iterations after which a contact whose friction turns back is held. Sweep: 2 and 8 take 21 and 17 % more in a
  // crumple.
  int reversals_from = 4;
  // Changes of the active set of pairs in an iteration. Sweep: 3 takes 29 % more in a crumple, 12 changes nothing but
  // on a ball.
  int rounds_max = 6;
  // Relative tolerance of GMRES with pairs, whose gaps it predicts: with 0.18 a sheet on an incline took 956
  // iterations, with 1e-4 12. Sweep: 5e-5 takes 24 % and 2e-4 2 % more GMRES iterations in a fold.
  double pairs_tolerance = 1e-4;
  // Absolute tolerance of GMRES over that of forces, so that a solved linear problem can end the step. Sweep: 0.15
  // takes 14 % less in a crumple.
  double linear_share = 0.3;
  // Iterations whose largest residual bounds the next [Grippo et al. 1986]. Sweep: 2 takes 28 % more in a crumple and
  // 23 % more in a squeeze, 8 takes 6 to 7 % more.
  int window = 4;
  // Halvings of a correction along its line. Sweep: GMRES takes 18 % more with 2 and 4 % less with 8 in a fold, and 15
  // % more with 5 in a pile.
  int cuts_max = 4;
  // Length of the first smoothing over h, and of each smoothing over the one before. Sweep: 0.05 and 0.2 take 21 and 20
  // % more in a crumple.
  double smoothing_ratio = 0.1;
  // Residual, over the mean force of smoothing, from which the law becomes sharper. Sweep: 2.5 and 10 take 9 and 19 %
  // more in a crumple.
  double smooth_near = 5.0;
  // Relative tolerance of GMRES under the smoothed law, whose matrix is the worse conditioned the sharper it is. Sweep:
  // 5e-7 and 2e-6 take 7 and 19 % more in a crumple.
  double smooth_tolerance = 1e-6;
  // Margins (path.margin) that a node may go in an iteration under the smoothed law, and hops of its search. Sweep: 2
  // takes 5 % more and 8 takes 1 % less in a crumple.
  int smooth_hops = 4;
  // Hops of the search for candidates that a correction may take: farther away, nodes meet pairs outside the list.
  // Sweep: 2 takes 1 % more in a fold and a crumple.
  int hops = 1;
  // Decrease of the squares of forces that is slow for the matrix of a convex energy: Newton's method with the exact
  // one, which halves forces at least, takes its place. Sweep: 0.125 and 0.5 take 6 % more and 3 % less in a crumple.
  double slow = 0.25;
  // Decrease of the squares of forces, a hundredth of the forces, from which an attempt goes on beyond its iterations,
  // with the exact matrix. Sweep: half and twice take 3 and 14 % less in a crumple.
  double nearly = 1e-4;
  // Iterations within which such an attempt halves the squares of forces. Sweep: 8 takes 2 to 3 % less, 30 takes 1 to 9
  // % more.
  int halving_iterations = 15;
  // Times the iterations up to which it goes on. Sweep: 2 takes 42 % more in a pile, 8 changes nothing.
  int longest = 4;
  // Share to which all nodes are shortened together before single ones are stopped, which strains the cloth. Sweep:
  // 0.05 and 0.2 take 20 and 8 % more in a crumple.
  double common_least = 0.1;

  SIM_CORE_NAMED(reversals_from, rounds_max, pairs_tolerance, linear_share, window, cuts_max, smoothing_ratio,
                 smooth_near, smooth_tolerance, smooth_hops, hops, slow, nearly, halving_iterations, longest,
                 common_least)
};

}  // namespace sim_core
