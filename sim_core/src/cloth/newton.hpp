// One implicit step: M (x - x0 - dt v0)/dt^2 + c M (x - x0)/dt + grad E(x) = M g + contact, by Newton's method.
#pragma once

#include <memory>
#include <vector>

#include "cloth/assembly.hpp"
#include "cloth/factor.hpp"
#include "cloth/settings.hpp"
#include "contact/contact_set.hpp"
#include "contact/state.hpp"

namespace sim_core {

// The linear problem of one iteration, with the active set of pairs.
class Correction {
 public:
  Correction(Assembly& assembly, const ClothSettings& settings, const Constants& constants, ContactState& contact);
  Correction(const Correction&) = delete;

  FactorPool factors;
  Buffer<float> change;  // of the free nodes, (free nodes, 4), m

  // Solves J change = -F for a step of dt, in the directions that contact leaves free; contact prescribes the others.
  // `pairs` may be null. Repeats with the active set that the solution asks for; returns whether all rounds of that
  // were taken.
  bool solve(ContactSet* pairs, const Buffer<double>& x, double dt, StepReport& report);

 private:
  void solve_with_pairs(ContactSet& pairs, const Buffer<double>& x, double dt, StepReport& report);
  // Returns the iterations of GMRES.
  int solve_linear(const ContactSet* pairs, const Factor& factor, double krylov_tolerance);
  void subtract_corrections(const ContactSet* pairs);

  Assembly& assembly_;
  ClothSettings settings_;
  NewtonSettings constants_;
  ContactState& contact_;
  PairFactor pair_factor_;
  PairData pair_rows_{};
  Buffer<float> work_, image_, force_;
};

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
  Newton(Assembly& assembly, const ClothSettings& settings, const Constants& constants);
  Newton(const Newton&) = delete;

  ContactState contact;
  Correction correction;
  std::unique_ptr<ContactSet> pairs;  // null without self-contact and surfaces
  Buffer<double> residual;            // (nodes, 4), N: R = M a + grad E - M g, the force that a node needs from contact
  // Iterations in a row that are stopped short, or take all rounds, after which an attempt is given up.
  int strained_max = 0;

  // Solves for the free nodes of x, or leaves the best found in it; its held nodes are at their ends. `from_rest`:
  // begins at the start of the step, not where the velocity leads. `smoothly`: by way of a law of pairs that is smooth,
  // and ever less so; that takes more iterations and ends where the other way does not. Nothing crosses on the way from
  // the start of the step, held nodes included, which arrive as pairs let them.
  StepOutcome solve(const StepProblem& problem, Buffer<double>& x, bool from_rest, int iterations, StepReport& report,
                    bool smoothly);

  // Where the velocity leads the free nodes of x, or the start, out of the bodies and surfaces; these are at `ends`.
  void predict(const StepProblem& problem, const Buffer<double>& ends, Buffer<double>& x, bool from_rest);

 private:
  // `share`: of the last changes of the pairs' forces.
  Norms look(const StepProblem& problem, const Buffer<double>& x, double share = 0.0);
  void begin(const StepProblem& problem, Buffer<double>& x, bool from_rest, bool smoothly);
  Norms move(const StepProblem& problem, const Buffer<double>& x, double share, bool smoothly);
  void choose_matrix(const Buffer<double>& x, double before, double now, bool whole, bool close);
  bool arrived(const Buffer<double>& x) const;
  double reach() const;
  bool sharpen(const StepProblem& problem, const Buffer<double>& x, double share, Norms& norms);

  Assembly& assembly_;
  ClothSettings settings_;
  NewtonSettings constants_;
  double law_stiffness_, length_tolerance_;  // see ContactSettings
  bool strained_ = false;                    // whether the last correction was stopped short or took all rounds
  Buffer<double> trial_, wanted_, best_, ends_;
  std::vector<double> own_stiffness_;  // of contacts, without that of pairs, N/m
};

}  // namespace sim_core
