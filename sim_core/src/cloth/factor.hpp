// A Cholesky factor that is kept while it is worth keeping: the preconditioner of every linear solve.
#pragma once

#include <memory>
#include <vector>

#include "cloth/assembly.hpp"
#include "cloth/numbering.hpp"
#include "cloth/problem.hpp"
#include "cloth/settings.hpp"
#include "contact/state.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// The arrays behind the multifrontal factor: which rows each front has, and what of the matrix goes into it.
struct FactorStorage {
  // Fronts that are made anew together, by one of them: a small subtree by its root, a large front by itself. What
  // waits of it for the parent is kept, so that the parent can be made anew without it.
  std::vector<int> piece;
  std::vector<char> due;
  std::vector<double> work;  // of each front, flops
  std::vector<int> pivot_begin, row_begin, rows, child_begin, children, run_begin;
  std::vector<int> entry_slot, entry_block, entry_row, entry_column;
  std::vector<FrontRun> runs;
  std::vector<long> tile_begin, entry_begin, update_begin;
  Buffer<float> tiles, panel, updates, local;

  // Patterns in the numbers of the order of elimination; that of bending holds that of the membrane.
  FactorStorage(const Pattern& bending, const Pattern& membrane, const Dissection& dissection);

  Factor view();

  // Marks fronts as due: all of them, or those pieces in which `touched` (free nodes) is set, and what they lead to.
  // The latter returns their share of the work.
  void mark_all();
  double mark(const std::vector<char>& touched);
};

// GMRES iterations that a factor has cost since it was new.
class FactorCost {
 public:
  void restart() { fresh_ = -1, last_ = excess_ = 0; }
  void spent(int iterations);
  // Whether a new one would have cost less, or may help.
  bool too_much(const ClothSettings& settings) const {
    return excess_ > settings.refactor_after || last_ >= settings.krylov_max;
  }

 private:
  int last_ = 0, fresh_ = -1, excess_ = 0;  // of the last solve, of the first, and beyond that
};

class StaleFactor {
 public:
  explicit StaleFactor(const Numbering& numbering);
  StaleFactor(const StaleFactor&) = delete;

  const Factor& view() const { return view_; }

  // Whether it is for steps of this length.
  bool fits(double dt) const;
  // Makes it anew if it never was made or has cost more GMRES iterations than a new one would; where it is of other
  // contacts, those parts that hold them. Returns the share that was made.
  double renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, double dt,
               const ClothSettings& settings);
  void make(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, double dt);
  void spent(int iterations) { cost_.spent(iterations); }
  void forget() { made_ = false; }

 private:
  void refresh(const Assembly& assembly, const ContactState& contact);

  FactorStorage storage_;
  Factor view_;
  // Without contact. Parts are made anew of the same: of one that moved on they would not fit the others.
  ClothMatrix matrix_{};
  NeighbourNumbers numbers_;
  Buffer<float> added_;
  std::vector<int> modes_;     // that it was made for
  std::vector<char> touched_;  // nodes whose modes are others now
  bool made_ = false;
  double dt_ = 0.0;
  FactorCost cost_;
};

// Factors for the lengths of step of late: a length that recurs is not factored again.
class FactorPool {
 public:
  // `size`: factors that are kept.
  FactorPool(const Numbering& numbering, int size);

  // That for steps of dt, or one to be made in place of the one that was needed least recently.
  StaleFactor& of(double dt);
  StaleFactor& latest() { return *factors_.front(); }

 private:
  std::vector<std::unique_ptr<StaleFactor>> factors_;  // the latest first
  const Numbering& numbering_;
  std::size_t size_;
};

}  // namespace sim_core
