// Equilibria of suspended rods: the interface of the solver, free of lanes and of Python.
#pragma once

#include <cstdint>
#include <vector>

namespace sim_core {

struct RodSettings {
  double twist_stiffness;  // C = GJ/EI
  int elements;            // of the finest of three levels: elements / 4, elements / 2, elements
  int start_level;         // 0, 1 or 2: the level that starts from the natural shape
};

// Where and how an output point reads the nodes of the middle level (elements / 2): quintic Hermite
// interpolation between node and node + 1 of a field y known with y', y'' in arc length.
struct SamplePoint {
  int node;
  double weight[6];  // of y, y', y'' at node, then at node + 1
};

// What is computed of n rods, row-major; see solve.py for the conventions.
struct RodOutput {
  double* centerline;        // (n, points, 3), L
  double* curvature;         // (n, points, 3), 1/L
  double* frame;             // (n, points, 3, 3): row-major R, whose columns are d1, d2, d3
  double* energy;            // (n), EI/L
  double* residual;          // (n), EI/L: largest out-of-balance nodal moment before the last step
  double* refinement;        // (n), rad: largest turn of a frame by the extrapolation's last term
  std::int32_t* iterations;  // (n)
  bool *converged, *stable;  // (n)
};

// n uniform rods.
struct RodBatch {
  const double *gamma, *phi0, *phi1;  // (n): weight, natural twist, natural bend
  RodOutput output;
};

// n rods of varying natural curvature; N = elements of the finest level, P = output points. See
// solve.py.
struct GeneralRodBatch {
  const double* gamma;      // (n)
  const double* stiffness;  // (n, 3), EI
  const double* clamp;      // (n, 4): unit quaternions (w, x, y, z)
  const double* natural;    // (n, 2 N + 1, 3), 1/L: natural curvature at uniform arc length
  const double* start;  // (n, 2 N + 1, 3), 1/L: curvature of the shape that the search starts from
  const double* slope;  // (n, N / 2 + 1, 3), 1/L^2: derivative of the natural curvature
  const double* natural_at_points;  // (n, P, 3), 1/L
  RodOutput output;
};

// Solves the rods [begin, end) of a batch.
template <class Batch>
using RodKernel = void (*)(const Batch&, const RodSettings&, const std::vector<SamplePoint>&,
                           std::int64_t begin, std::int64_t end);

// What is compiled for one instruction set: kernel.cpp is the code of all of them, and all return
// the same bits. They are constants, so that no code for wider vectors runs where they are listed.
struct RodKernels {
  RodKernel<RodBatch> solve;
  RodKernel<GeneralRodBatch> solve_general;
};
extern const RodKernels rods_baseline, rods_x86_64_v3, rods_x86_64_v4;

// The coarsest level on which the search from the natural shape is reliable. Measured over gamma
// 100 ... 1300, phi0 0.2 ... 12, phi1 6 ... 20: 16 elements fail in 0.4 % of the rods, 24 in none.
int default_start_level(int elements);

// Throw std::invalid_argument for settings that the solver cannot run, or cannot run for a natural
// curvature this large.
void check_settings(const RodSettings& settings, int points, double curvature_max);

// `points` points of uniform arc length from s = 0 to s = 1, both included.
std::vector<SamplePoint> sample_points(int points, int elements);

// Three levels, the coarsest with the four nodes that interpolation between levels needs.
constexpr int elements_min = 12;

// Largest rotation of an element of the coarsest level in the natural shape [rad]; below pi with
// room for the search.
constexpr double element_turn_max = 2.5;

}  // namespace sim_core
