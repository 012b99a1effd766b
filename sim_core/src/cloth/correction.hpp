// The linear problem of one iteration of Newton's method, with the active set of pairs.
#pragma once

#include "cloth/assembly.hpp"
#include "cloth/constants.hpp"
#include "cloth/factor.hpp"
#include "cloth/pair_factor.hpp"
#include "cloth/settings.hpp"
#include "contact/contact_set.hpp"
#include "contact/state.hpp"

namespace sim_core {

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

}  // namespace sim_core
