// A Cholesky factor that is kept while it is worth keeping: the preconditioner of every linear solve.
#pragma once

#include "cloth/assembly.hpp"
#include "cloth/fronts.hpp"
#include "cloth/settings.hpp"
#include "contact/state.hpp"

namespace sim_core {

class StaleFactor {
 public:
  explicit StaleFactor(const Numbering& numbering);
  StaleFactor(const StaleFactor&) = delete;

  const Factor& view() const { return view_; }
  const FactorStorage& storage() const { return storage_; }

  // A factor for steps of another length is of no use.
  void expect(double dt) { made_ = made_ && dt == dt_; }
  // Whether it never was made, has cost more GMRES iterations than a new one would, or is of other contacts.
  bool stale(const std::vector<int>& modes, const ClothSettings& settings) const;
  void make(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, double dt);
  void spent(int iterations);
  void forget() { made_ = false; }

 private:
  FactorStorage storage_;
  Factor view_;
  Buffer<float> added_;
  std::vector<int> modes_;  // that it was made for
  bool made_ = false;
  double dt_ = 0.0;
  int last_ = 0, fresh_ = -1, excess_ = 0;  // iterations of the last solve, of the first, and beyond that
};

}  // namespace sim_core
