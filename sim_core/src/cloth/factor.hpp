// A Cholesky factor that is kept while it is worth keeping: the preconditioner of every linear solve.
#pragma once

#include "cloth/assembly.hpp"
#include "cloth/fronts.hpp"
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
  // Whether it has cost more than `excess_max` GMRES iterations beyond those of its first solve, or never was made.
  bool stale(int excess_max, int krylov_max) const;
  void make(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, double dt);
  void spent(int iterations);
  void forget() { made_ = false; }

 private:
  FactorStorage storage_;
  Factor view_;
  Buffer<float> added_;
  bool made_ = false;
  double dt_ = 0.0;
  int last_ = 0, fresh_ = -1, excess_ = 0;  // iterations of the last solve, of the first, and beyond that
};

}  // namespace sim_core
