// Newton's method for the equilibrium of a chain: exact block-tridiagonal Hessian, block
// elimination, line search.
//
// Eliminating the nodes from the clamp on leaves 3x3 pivots P_i = D_i - O_i^T P_{i-1}^{-1} O_i. The
// Hessian is positive definite if and only if every pivot is, so a Newton step brings the
// certificate of stability with it. One sweep evaluates energy, gradient, Hessian and step at once;
// lanes never wait inside a line search.
#pragma once

#include <vector>

#include "math/lanes.hpp"
#include "rods/energy.hpp"

namespace sim_core {
namespace {

// Largest rotation of a node in one step [rad].
constexpr double step_cap = 1.5;
// Armijo's fraction of the decrease that the gradient predicts.
constexpr double sufficient_decrease = 1e-4;
// Sweeps after which any step downhill will do, the Hessian definite or not: a start that symmetry
// holds on a saddle gets there by plain Newton steps. Of 22,000 rods over the thesis's ranges none
// took more than 37 sweeps.
constexpr int sweeps_definite = 40;
// Sweeps after which a level gives up.
constexpr int sweeps_max = 200;

// Converged frames of one level and how they were reached.
template <int W>
struct Level {
  using T = Lanes<W>;

  int elements;
  std::vector<Quat<T>> frame;     // (elements + 1): nodal frames; the clamp is frame[0]
  std::vector<Vec3<T>> moment;    // (elements + 1): nodal moment in the material frame, EI/L
  T energy{};                     // EI/L
  T residual{};                   // largest out-of-balance nodal moment before the last step, EI/L
  T sweeps{};                     // evaluations of the Hessian
  Mask<W> converged{}, stable{};  // last step within tolerance; Hessian positive definite there

  double h() const { return 1.0 / elements; }
};

template <int W>
struct NewtonWorkspace {
  using T = Lanes<W>;

  std::vector<Quat<T>> trial;     // frames under evaluation
  std::vector<Vec3<T>> step;      // rotation of each node from the last accepted frames
  std::vector<Mat3<T>> coupling;  // P_i^{-1} O_i
  std::vector<Vec3<T>> partial;   // P_i^{-1} b_i

  explicit NewtonWorkspace(int elements_max)
      : trial(elements_max + 1),
        step(elements_max + 1),
        coupling(elements_max + 1),
        partial(elements_max + 1) {}
};

// What one sweep over the chain finds at the trial frames.
template <int W>
struct Sweep {
  Lanes<W> energy, slope, residual2;  // slope = gradient . step; residual2 = max_i |gradient_i|^2
  Mask<W> definite,
      representable;  // all pivots positive definite; no element turned by more than pi
};

// Assemble at the trial frames and eliminate forwards.
//
// What makes the Hessian indefinite far from equilibrium is the weight of the parts that point up:
// at a node of weight w its least curvature is -w (1 + t_z) / 2. That much, times `shift`, is added
// to the node's diagonal.
template <int W, class AnyRod>
[[gnu::flatten]] Sweep<W> eliminate(const AnyRod& rod, int elements, Lanes<W> shift,
                                    NewtonWorkspace<W>& work) {
  using T = Lanes<W>;
  const double h = 1.0 / elements, inverse_h = elements;
  Sweep<W> sweep{T(0.0), T(0.0), T(0.0), Mask<W>(true), Mask<W>(true)};
  T cosine_least(1.0);
  Sym3<T> diagonal{};  // of the node between the last element and the next, eliminated up to it
  Vec3<T> force{}, right_side{};
  const auto eliminate_node = [&](int i, Sym3<T> P, Vec3<T> b) {
    // Inverse by cofactors: Sylvester's leading minors come out on the way.
    const T cxx = P.yy * P.zz - P.yz * P.yz, cxy = P.xz * P.yz - P.xy * P.zz,
            cxz = P.xy * P.yz - P.xz * P.yy;
    const T cyy = P.xx * P.zz - P.xz * P.xz, cyz = P.xy * P.xz - P.xx * P.yz,
            czz = P.xx * P.yy - P.xy * P.xy;
    const T determinant = P.xx * cxx + P.xy * cxy + P.xz * cxz;
    sweep.definite =
        sweep.definite & less(T(0.0), P.xx) & less(T(0.0), czz) & less(T(0.0), determinant);
    const T r = T(1.0) / determinant;
    const Sym3<T> inverse{r * cxx, r * cxy, r * cxz, r * cyy, r * cyz, r * czz};
    work.partial[i] = inverse * b;
    sweep.slope = sweep.slope - dot(b, work.partial[i]);
    return inverse;
  };

  for (int i = 0; i < elements; ++i) {
    const Quat<T> a = work.trial[i], b = work.trial[i + 1];
    const auto& here = section(rod, i, elements);
    const auto moment = element_moment(here, a, b, T(h), T(inverse_h));
    const Element<T> e = element(here, moment, T(inverse_h));
    sweep.energy = sweep.energy + e.energy;
    cosine_least = select(less(moment.cosine, cosine_least), moment.cosine, cosine_least);

    const T weight =
        rod.gamma * T((1.0 - i * h) * h);  // (gamma) (1 - s) h; half of it at the clamp
    const Vec3<T> t = direction1(a);
    if (i == 0) {
      sweep.energy = sweep.energy + T(0.5) * weight * t.z;
      diagonal = e.stiffness;
    } else {
      sweep.energy = sweep.energy + weight * t.z;
      const Vec3<T> gradient = force - e.force + weight_torque(weight, t);
      sweep.residual2 = max(sweep.residual2, dot(gradient, gradient));
      const T s = shift * T(0.5) * weight * (T(1.0) + t.z);
      const Sym3<T> P = diagonal + e.stiffness + weight_stiffness(weight, t) +
                        Sym3<T>{s, T(0.0), T(0.0), s, T(0.0), s};
      const Vec3<T> rhs = T(-1.0) * (gradient + right_side);
      const Sym3<T> inverse = eliminate_node(i, P, rhs);
      // O = -S + [f]x / 2, by columns.
      const Sym3<T> S = e.stiffness;
      const Vec3<T> f = T(0.5) * e.force;
      const Mat3<T> O{{-S.xx, f.z - S.xy, -(S.xz + f.y)},
                      {-(S.xy + f.z), -S.yy, f.x - S.yz},
                      {f.y - S.xz, -(S.yz + f.x), -S.zz}};
      const Mat3<T> B{inverse * O.x, inverse * O.y, inverse * O.z};
      work.coupling[i] = B;
      diagonal = S - Sym3<T>{dot(O.x, B.x), dot(O.x, B.y), dot(O.x, B.z),
                             dot(O.y, B.y), dot(O.y, B.z), dot(O.z, B.z)};
      const Vec3<T> y = work.partial[i];
      right_side = {dot(O.x, y), dot(O.y, y), dot(O.z, y)};
    }
    force = e.force;
  }
  sweep.residual2 = max(sweep.residual2, dot(force, force));
  eliminate_node(elements, diagonal,
                 T(-1.0) * (force + right_side));  // the free end bears no weight
  sweep.representable = less(T(0.0), cosine_least);
  return sweep;
}

// Minimise the energy from level.frame until a Newton step turns no node by more than `tolerance`
// [rad], and take that step too: the error left is of the order of its square. A start that
// symmetry holds on a saddle (a planar rod that would rather leave its plane) ends balanced:
// converged, but not stable.
template <int W, class AnyRod>
void minimise(const AnyRod& rod, Level<W>& level, NewtonWorkspace<W>& work, double tolerance) {
  using T = Lanes<W>;
  const int n = level.elements;
  for (int i = 0; i <= n; ++i) work.trial[i] = level.frame[i];
  for (int i = 0; i <= n; ++i) work.step[i] = Vec3<T>{T(0.0), T(0.0), T(0.0)};

  // Rounding noise of an energy of this size must not look like an ascent.
  const T scale = energy_scale(rod);
  const T slack = T(1e-12) * scale;
  const T balance = T(1e-11) * scale;
  T base_energy(1e300), slope(0.0), length(0.0), shift(1.0);
  Mask<W> done(false);
  level.converged = level.stable = Mask<W>(false);
  level.residual = level.sweeps = T(0.0);

  for (int count = 0; count < sweeps_max && any(!done); ++count) {
    const Sweep<W> sweep = eliminate(rod, n, shift, work);
    const T bound = base_energy + T(sufficient_decrease) * length * slope + slack;
    const Mask<W> accepted = sweep.representable & less_equal(sweep.energy, bound) & !done;
    const Mask<W> descends = Mask<W>(count >= sweeps_definite) & less(sweep.slope, T(0.0));
    const Mask<W> advance = accepted & (sweep.definite | descends);
    const Mask<W> unshifted = less_equal(shift, T(0.0));
    base_energy = select(accepted, sweep.energy, base_energy);
    slope = select(advance, sweep.slope, slope);
    level.residual = select(accepted, sqrt(sweep.residual2), level.residual);
    level.sweeps = select(done, level.sweeps, level.sweeps + T(1.0));

    T turn2(0.0);
    Vec3<T> next{T(0.0), T(0.0), T(0.0)};
    for (int i = n; i >= 1; --i) {
      next = i == n ? work.partial[i] : work.partial[i] - work.coupling[i] * next;
      work.step[i] = select(advance, next, work.step[i]);
      turn2 = max(turn2, dot(next, next));
    }

    // Lanes that advance try a full (capped) step, and no shift next; lanes with an indefinite
    // Hessian stay and raise the shift; lanes whose trial was refused halve their step.
    const T capped = select(less(T(step_cap * step_cap), turn2), T(step_cap) / sqrt(turn2), T(1.0));
    const Mask<W> settled =
        advance & sweep.definite & unshifted & less_equal(turn2, T(tolerance * tolerance));
    const Mask<W> balanced =
        accepted & unshifted & !sweep.definite & less_equal(level.residual, balance);
    const Mask<W> finished = settled | balanced;
    length = select(advance & !balanced, capped, select(accepted, T(0.0), T(0.5) * length));
    const T raised = select(unshifted, T(1.0), T(2.0) * shift);
    const T lowered = select(less(T(1.0), shift), T(0.5) * shift, T(0.0));
    shift = select(advance, lowered, select(accepted, raised, shift));

    for (int i = 1; i <= n; ++i) {
      level.frame[i] = select(accepted, work.trial[i], level.frame[i]);
      const Quat<T> moved = renormalized(retraction(length * work.step[i]) * level.frame[i]);
      work.trial[i] = select(done, work.trial[i], moved);
    }
    level.stable = level.stable | settled;
    level.converged = level.converged | finished;
    done = done | finished;
  }
  for (int i = 1; i <= n; ++i)
    level.frame[i] = select(level.converged, work.trial[i], level.frame[i]);
}

}  // namespace
}  // namespace sim_core
