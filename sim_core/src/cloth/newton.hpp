// One implicit step: M (x - x0 - dt v0)/dt^2 + c M (x - x0)/dt + grad E(x) = M g + contact, by Newton's method.
#pragma once

#include <memory>
#include <vector>

#include "cloth/assembly.hpp"
#include "cloth/factor.hpp"
#include "cloth/pair_factor.hpp"
#include "cloth/settings.hpp"
#include "contact/pairs.hpp"
#include "contact/state.hpp"

namespace sim_core {

// What a step starts from and is driven by.
struct StepProblem {
  double dt, damping;              // s, 1/s: on top of the fabrics' own
  const Buffer<double>& start;     // (nodes, 4): positions at its start, m
  const Buffer<double>& inertial;  // (nodes, 4): where inertia and gravity alone lead, x0 + dt v0 + dt^2 g
  const Buffer<double>& velocity;  // (nodes, 4): at its start, m/s
  const std::vector<Body>&at_start, &at_end;
};

struct StepOutcome {
  bool converged;
  double residual;  // N
};

class Newton {
 public:
  Newton(Assembly& assembly, const ClothSettings& settings);
  Newton(const Newton&) = delete;

  ContactState contact;
  FactorPool factors;
  std::unique_ptr<Pairs> pairs;  // of cloth with cloth; null where it does not feel itself
  Buffer<double> residual;       // (nodes, 4), N: R = M a + grad E - M g, the force that a node needs from contact
  ClothPhases phases;
  // Iterations in a row that are stopped short, or take all rounds, after which an attempt is given up.
  int strained_max = 0;

  // Solves for the free nodes of x, or leaves the best found in it; its held nodes are at their ends. `from_rest`:
  // begins at the start of the step, not where the velocity leads. GMRES stops at `krylov_tolerance` of its right-hand
  // side. `smoothly`: by way of a law of pairs that is smooth, and ever less so; that takes more iterations and ends
  // where the other way does not. Nothing crosses on the way from the start of the step, held nodes included, which
  // arrive as pairs let them.
  StepOutcome solve(const StepProblem& problem, Buffer<double>& x, bool from_rest, int iterations, StepReport& report,
                    double krylov_tolerance, bool smoothly);

  // Where the velocity leads the free nodes of x, or the start, out of the bodies and surfaces; these are at `ends`.
  void predict(const StepProblem& problem, const Buffer<double>& ends, Buffer<double>& x, bool from_rest);

  void evaluate(const Buffer<double>& x, bool with_matrix);

 private:
  // `share`: of the last changes of the pairs' forces.
  Norms look(const StepProblem& problem, const Buffer<double>& x, double share = 0.0);
  void correct(const StepProblem& problem, const Buffer<double>& x, double krylov_tolerance, StepReport& report);
  void correct_with_pairs(const StepProblem& problem, const Buffer<double>& x, StepReport& report);
  KrylovResult solve_linear(const Factor& factor, double krylov_tolerance);
  void subtract_corrections();
  bool arrived(const Buffer<double>& x) const;
  double reach() const;
  bool sharpen(const StepProblem& problem, const Buffer<double>& x, double share, Norms& norms);

  Assembly& assembly_;
  ClothSettings settings_;
  PairFactor pair_factor_;
  PairData pair_rows_{};
  bool strained_ = false;  // whether the last correction was stopped short or took all rounds
  Buffer<double> trial_, wanted_, best_, ends_;
  std::vector<double> own_stiffness_;  // of contacts, without that of pairs, N/m
  Buffer<float> change_, work_, image_, force_;
};

}  // namespace sim_core
