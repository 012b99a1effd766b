// Equilibria of rods with distributed natural curvature: the interface of the solver, free of lanes and of Python.
#pragma once

#include "rods/rods.hpp"

namespace sim_core {

// n rods, all row-major; N = elements of the finest level, P = output points. See general_rods.py for the conventions.
struct GeneralRodBatch {
  const double* gamma;              // (n)
  const double* stiffness;          // (n, 3), EI
  const double* clamp;              // (n, 4): unit quaternions (w, x, y, z)
  const double* natural;            // (n, 2 N + 1, 3), 1/L: natural curvature at uniform arc length
  const double* start;              // (n, 2 N + 1, 3), 1/L: curvature of the shape that the search starts from
  const double* slope;              // (n, N / 2 + 1, 3), 1/L^2: derivative of the natural curvature
  const double* natural_at_points;  // (n, P, 3), 1/L
  RodOutput output;
};

}  // namespace sim_core
