// The rod solver: packs of W rods through the levels, then to the limit, then to the output points.
#include <vector>

#include "rods/general_rod.hpp"
#include "rods/levels.hpp"
#include "rods/rods.hpp"

namespace sim_core {
namespace {

// From nodal frames and moments to the output points.
//
// The Kirchhoff equations give the derivatives of everything at the nodes [Bertails-Descoubes et
// al. 2018, Eq. 1-4]:
//   kappa = kappa_bar + K^{-1} m,   m' = m x kappa - gamma (1 - s) e_x x g,   g' = g x kappa,   r'
//   = t,
// with g the direction of gravity in the material frame; quintic Hermite interpolation does the
// rest.

// A field with its first and second derivatives in s.
template <class Field>
struct Jet {
  Field y, d1, d2;
};

template <class T>
struct NodeJets {
  Jet<Vec3<T>> moment, centerline;
  Jet<Quat<T>> frame;
  Vec3<T> bend;  // t'' in the world; centerline holds r, r' = t, r'' = t'
};

// Everything but the position, which is a sum over the nodes before.
template <class T, class Section>
NodeJets<T> node_jet(const Section& section, T gamma, double s, Quat<T> q, Vec3<T> m) {
  const Vec3<T> d1 = direction1(q), d2 = direction2(q), d3 = direction3(q);
  const Vec3<T> g{-d1.z, -d2.z, -d3.z};
  const Vec3<T> kappa = curvature(section, m);
  const T load = gamma * T(1.0 - s);
  const auto turned_by_tangent = [](Vec3<T> v) { return Vec3<T>{T(0.0), -v.z, v.y}; };  // e_x x v
  const Vec3<T> dm = cross(m, kappa) - load * turned_by_tangent(g);
  const Vec3<T> dkappa = curvature_rate(section, dm);
  const Vec3<T> dg = cross(g, kappa);
  const Vec3<T> ddm = cross(dm, kappa) + cross(m, dkappa) + gamma * turned_by_tangent(g) -
                      load * turned_by_tangent(dg);
  const Quat<T> dq = spin(q, kappa);
  const Quat<T> ddq = spin(dq, kappa) + spin(q, dkappa);
  // t' = R (kappa x e_x), t'' = R (kappa x (kappa x e_x) + kappa' x e_x)
  const Vec3<T> dt = kappa.z * d2 - kappa.y * d3;
  const Vec3<T> ddt = T(-1.0) * (kappa.y * kappa.y + kappa.z * kappa.z) * d1 +
                      (kappa.x * kappa.y + dkappa.z) * d2 + (kappa.x * kappa.z - dkappa.y) * d3;
  return {{m, dm, ddm}, {Vec3<T>{}, d1, dt}, {q, dq, ddq}, ddt};
}

template <class T, class Field>
Field hermite(const SamplePoint& p, const Jet<Field>& a, const Jet<Field>& b) {
  return (T(p.weight[0]) * a.y + T(p.weight[1]) * a.d1 + T(p.weight[2]) * a.d2) +
         (T(p.weight[3]) * b.y + T(p.weight[4]) * b.d1 + T(p.weight[5]) * b.d2);
}

template <int W, class AnyRod>
[[gnu::flatten]] void node_jets(const AnyRod& rod, const Limit<W>& limit,
                                std::vector<NodeJets<Lanes<W>>>& nodes) {
  using T = Lanes<W>;
  const int n = static_cast<int>(limit.frame.size()) - 1;
  const double h = 1.0 / n;
  nodes.resize(n + 1);
  for (int i = 0; i <= n; ++i)
    nodes[i] = node_jet(node_section(rod, i, n), rod.gamma, i * h, limit.frame[i], limit.moment[i]);
  // Quintic Hermite quadrature of the tangent, error O(h^7) per interval.
  for (int i = 0; i < n; ++i) {
    const NodeJets<T>&a = nodes[i], &b = nodes[i + 1];
    nodes[i + 1].centerline.y = a.centerline.y + T(h / 2.0) * (a.centerline.d1 + b.centerline.d1) +
                                T(h * h / 10.0) * (a.centerline.d2 - b.centerline.d2) +
                                T(h * h * h / 120.0) * (a.bend + b.bend);
  }
}

// Write lane l of a vector to out[l * stride ...], for those of the first `count` lanes that the
// mask names.
template <int W>
void scatter(Vec3<Lanes<W>> v, double* out, std::int64_t stride, int step, Mask<W> mask,
             int count) {
  for (int lane = 0; lane < count; ++lane) {
    if (mask.v[lane] == 0) continue;
    double* to = out + lane * stride;
    to[0] = v.x.v[lane];
    to[step] = v.y.v[lane];
    to[2 * step] = v.z.v[lane];
  }
}

// Sample the masked ones of the first `count` lanes into rods begin ... begin + count of the batch.
template <int W, class AnyRod>
[[gnu::flatten]] void sample(const AnyRod& rod, const std::vector<NodeJets<Lanes<W>>>& nodes,
                             const std::vector<SamplePoint>& points, const RodOutput& output,
                             Mask<W> mask, std::int64_t begin, int count) {
  using T = Lanes<W>;
  const std::int64_t stride = 3 * static_cast<std::int64_t>(points.size());
  for (std::size_t j = 0; j < points.size(); ++j) {
    const SamplePoint& p = points[j];
    const NodeJets<T>&a = nodes[p.node], &b = nodes[p.node + 1];
    const Quat<T> q = normalized(hermite<T>(p, a.frame, b.frame));
    const Vec3<T> kappa =
        curvature(point_section(rod, static_cast<int>(j)), hermite<T>(p, a.moment, b.moment));
    const std::int64_t at = begin * stride + 3 * static_cast<std::int64_t>(j);
    scatter(hermite<T>(p, a.centerline, b.centerline), output.centerline + at, stride, 1, mask,
            count);
    scatter(kappa, output.curvature + at, stride, 1, mask, count);
    double* frame = output.frame + 3 * at;
    scatter(direction1(q), frame, 3 * stride, 3, mask, count);
    scatter(direction2(q), frame + 1, 3 * stride, 3, mask, count);
    scatter(direction3(q), frame + 2, 3 * stride, 3, mask, count);
  }
}

// Tolerances on the last Newton step [rad]; the error left is of the order of the square.
constexpr double tolerance_start = 1e-4;
constexpr double tolerance = 1e-6;

// Largest last term of the extrapolation [rad]. Levels that sit in different wells are further
// apart; levels too coarse for the rod are too.
constexpr double refinement_max = 0.02;

template <int W>
Level<W> level_of(int elements) {
  return {elements, std::vector<Quat<Lanes<W>>>(elements + 1),
          std::vector<Vec3<Lanes<W>>>(elements + 1)};
}

// Reads lane l from rod begin + l, each `stride` numbers after the one before; lanes past the end
// repeat the last rod.
template <int W>
Lanes<W> gather(const double* from, std::int64_t begin, int count, std::int64_t stride = 1) {
  Lanes<W> lanes;
  for (int lane = 0; lane < W; ++lane)
    lanes.v[lane] = from[stride * (begin + (lane < count ? lane : count - 1))];
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
      : levels{level_of<W>(elements / 4), level_of<W>(elements / 2), level_of<W>(elements)},
        work(elements) {}

  template <class AnyRod>
  void relax(const AnyRod& rod, int k, double tolerance) {
    minimise(rod, levels[k], work, tolerance);
    balance(rod, levels[k]);
    sweeps = sweeps + levels[k].sweeps;
    converged = converged & levels[k].converged;
  }

  // From the natural shape on one level to all three and to their limit.
  template <class AnyRod>
  void solve(const AnyRod& rod, int start) {
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
void mark_failed(const RodOutput& output, std::int64_t points, std::int64_t i) {
  const double nan = __builtin_nan("");
  for (std::int64_t j = 3 * points * i; j < 3 * points * (i + 1); ++j)
    output.centerline[j] = output.curvature[j] = nan;
  for (std::int64_t j = 9 * points * i; j < 9 * points * (i + 1); ++j) output.frame[j] = nan;
  output.energy[i] = output.refinement[i] = output.residual[i] = nan;
}

// Solve rods begin ... begin + count, count <= W. A rod that fails starts again on a finer level;
// whether it does depends on itself alone, and rods that are done are not touched.
template <int W, class AnyRod>
void solve_pack(const AnyRod& rod, const RodOutput& output, const RodSettings& settings,
                const std::vector<SamplePoint>& points, Solver<W>& solver, std::int64_t begin,
                int count) {
  using T = Lanes<W>;
  Mask<W> pending(true);
  solver.sweeps = T(0.0);
  for (int start = settings.start_level; start < 3 && any(pending); ++start) {
    solver.solve(rod, start);
    const Level<W>& fine = solver.levels[2];
    const Mask<W> converged =
        solver.converged & less_equal(solver.limit.refinement, T(refinement_max));
    const Mask<W> stable = converged & fine.stable;
    sample(rod, solver.nodes, points, output, pending, begin, count);
    for (int lane = 0; lane < count; ++lane) {
      if (pending.v[lane] == 0) continue;
      const std::int64_t i = begin + lane;
      output.energy[i] = solver.limit.energy.v[lane];
      output.refinement[i] = solver.limit.refinement.v[lane];
      output.residual[i] = fine.residual.v[lane];
      output.iterations[i] = static_cast<std::int32_t>(solver.sweeps.v[lane]);
      output.converged[i] = converged.v[lane] != 0;
      output.stable[i] = stable.v[lane] != 0;
    }
    pending = pending & !converged;
  }
  for (int lane = 0; lane < count; ++lane) {
    if (pending.v[lane] != 0)
      mark_failed(output, static_cast<std::int64_t>(points.size()), begin + lane);
  }
}

// Reads a uniform rod per lane.
template <int W>
struct RodReader {
  const RodBatch& batch;
  double twist_stiffness;

  RodReader(const RodBatch& rods, const RodSettings& settings, int)
      : batch(rods), twist_stiffness(settings.twist_stiffness) {}

  Rod<Lanes<W>> read(std::int64_t begin, int count) const {
    return {gather<W>(batch.gamma, begin, count), gather<W>(batch.phi0, begin, count),
            gather<W>(batch.phi1, begin, count), Lanes<W>(twist_stiffness)};
  }
};

// Reads a general rod per lane; the pack's fields lie here until the next.
template <int W>
struct GeneralRodReader {
  using T = Lanes<W>;

  const GeneralRodBatch& batch;
  int intervals;
  std::vector<Vec3<T>> natural, start, slope, points;

  GeneralRodReader(const GeneralRodBatch& rods, const RodSettings& settings, int count)
      : batch(rods),
        intervals(2 * settings.elements),
        natural(intervals + 1),
        start(intervals + 1),
        slope(intervals / 4 + 1),
        points(count) {}

  GeneralRod<T> read(std::int64_t begin, int count) {
    const auto gather_field = [&](const double* from, std::vector<Vec3<T>>& to) {
      const std::int64_t stride = 3 * static_cast<std::int64_t>(to.size());
      for (std::size_t k = 0; k < to.size(); ++k)
        to[k] = gather_vector(from + 3 * k, stride, begin, count);
    };
    gather_field(batch.natural, natural);
    gather_field(batch.start, start);
    gather_field(batch.slope, slope);
    gather_field(batch.natural_at_points, points);
    return {
        gather<W>(batch.gamma, begin, count),
        gather_vector(batch.stiffness, 3, begin, count),
        {gather<W>(batch.clamp, begin, count, 4), gather_vector(batch.clamp + 1, 4, begin, count)},
        intervals,
        natural.data(),
        start.data(),
        slope.data(),
        points.data()};
  }

  static Vec3<T> gather_vector(const double* from, std::int64_t stride, std::int64_t begin,
                               int count) {
    return {gather<W>(from, begin, count, stride), gather<W>(from + 1, begin, count, stride),
            gather<W>(from + 2, begin, count, stride)};
  }
};

template <int W, template <int> class Reader, class Batch>
void solve_range(const Batch& batch, const RodSettings& settings,
                 const std::vector<SamplePoint>& points, std::int64_t begin, std::int64_t end) {
  Solver<W> solver(settings.elements);
  Reader<W> reader(batch, settings, static_cast<int>(points.size()));
  for (std::int64_t i = begin; i < end; i += W) {
    const int count = end - i < W ? static_cast<int>(end - i) : W;
    solve_pack<W>(reader.read(i, count), batch.output, settings, points, solver, i, count);
  }
}

}  // namespace

constinit const RodKernels ROD_KERNELS = {solve_range<ROD_LANES, RodReader>,
                                          solve_range<ROD_LANES, GeneralRodReader>};

}  // namespace sim_core
