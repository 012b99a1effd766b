// The rod solver: packs of W rods through the levels, then to the limit, then to the output points.
#pragma once

#include <vector>

#include "rod_levels.hpp"
#include "rod_sampling.hpp"
#include "rods.hpp"

namespace sim_core {
namespace {

// Tolerances on the last Newton step [rad]; the error left is of the order of the square.
constexpr double tolerance_start = 1e-4;
constexpr double tolerance = 1e-6;

// Largest last term of the extrapolation [rad]. Levels that sit in different wells are further apart; levels too coarse
// for the rod are too.
constexpr double refinement_max = 0.02;

template <int W>
Level<W> level_of(int elements) {
  return {elements, std::vector<Quat<Lanes<W>>>(elements + 1), std::vector<Vec3<Lanes<W>>>(elements + 1)};
}

// Reads lane l from rod begin + l; lanes past the end repeat the last rod.
template <int W>
Lanes<W> gather(const double* from, std::int64_t begin, int count) {
  Lanes<W> lanes;
  for (int lane = 0; lane < W; ++lane) lanes.v[lane] = from[begin + (lane < count ? lane : count - 1)];
  return lanes;
}

// Three levels of a pack, each with half the elements of the next.
template <int W>
struct Solver {
  using T = Lanes<W>;

  Level<W> levels[3];
  Limit<W> limit;
  NewtonWorkspace<W> work;
  std::vector<Difference<T>> differences;
  std::vector<NodeJets<T>> nodes;
  T sweeps{};         // of all levels so far
  Mask<W> converged;  // on all levels so far

  explicit Solver(int elements)
      : levels{level_of<W>(elements / 4), level_of<W>(elements / 2), level_of<W>(elements)}, work(elements) {}

  void relax(const Rod<T>& rod, int k, double tolerance) {
    minimise(rod, levels[k], work, tolerance);
    balance(rod, levels[k]);
    sweeps = sweeps + levels[k].sweeps;
    converged = converged & levels[k].converged;
  }

  // From the natural shape on one level to all three and to their limit.
  void solve(const Rod<T>& rod, int start) {
    converged = Mask<W>(true);
    start_natural(rod, levels[start]);
    relax(rod, start, tolerance_start);
    for (int k = start - 1; k >= 0; --k) {
      start_within(levels[k + 1], levels[k]);
      relax(rod, k, tolerance_start);
    }
    for (int k = start + 1; k < 3; ++k) {
      start_from(rod, levels[k - 1], k > 1 ? &levels[k - 2] : nullptr, levels[k], differences);
      relax(rod, k, k == 2 ? tolerance : tolerance_start);
    }
    extrapolate(levels[0], levels[1], levels[2], limit, differences);
    node_jets(rod, limit, nodes);
  }
};

// A rod without a solution gets no numbers that could be taken for one.
void mark_failed(const RodBatch& batch, std::int64_t points, std::int64_t i) {
  const double nan = __builtin_nan("");
  for (std::int64_t j = 3 * points * i; j < 3 * points * (i + 1); ++j) batch.centerline[j] = batch.curvature[j] = nan;
  for (std::int64_t j = 9 * points * i; j < 9 * points * (i + 1); ++j) batch.frame[j] = nan;
  batch.energy[i] = batch.refinement[i] = batch.residual[i] = nan;
}

// Solve rods begin ... begin + count, count <= W. A rod that fails starts again on a finer level; whether it does
// depends on itself alone, and rods that are done are not touched.
template <int W>
void solve_pack(const RodBatch& batch, const RodSettings& settings, const std::vector<SamplePoint>& points,
                Solver<W>& solver, std::int64_t begin, int count) {
  using T = Lanes<W>;
  const Rod<T> rod{gather<W>(batch.gamma, begin, count), gather<W>(batch.phi0, begin, count),
                   gather<W>(batch.phi1, begin, count), T(settings.twist_stiffness)};
  Mask<W> pending(true);
  solver.sweeps = T(0.0);
  for (int start = settings.start_level; start < 3 && any(pending); ++start) {
    solver.solve(rod, start);
    const Level<W>& fine = solver.levels[2];
    const Mask<W> converged = solver.converged & less_equal(solver.limit.refinement, T(refinement_max));
    const Mask<W> stable = converged & fine.stable;
    sample(rod, solver.nodes, points, batch, pending, begin, count);
    for (int lane = 0; lane < count; ++lane) {
      if (pending.v[lane] == 0) continue;
      const std::int64_t i = begin + lane;
      batch.energy[i] = solver.limit.energy.v[lane];
      batch.refinement[i] = solver.limit.refinement.v[lane];
      batch.residual[i] = fine.residual.v[lane];
      batch.iterations[i] = static_cast<std::int32_t>(solver.sweeps.v[lane]);
      batch.converged[i] = converged.v[lane] != 0;
      batch.stable[i] = stable.v[lane] != 0;
    }
    pending = pending & !converged;
  }
  for (int lane = 0; lane < count; ++lane) {
    if (pending.v[lane] != 0) mark_failed(batch, static_cast<std::int64_t>(points.size()), begin + lane);
  }
}

template <int W>
void solve_range(const RodBatch& batch, const RodSettings& settings, const std::vector<SamplePoint>& points,
                 std::int64_t begin, std::int64_t end) {
  Solver<W> solver(settings.elements);
  for (std::int64_t i = begin; i < end; i += W) {
    solve_pack(batch, settings, points, solver, i, end - i < W ? static_cast<int>(end - i) : W);
  }
}

}  // namespace
}  // namespace sim_core
