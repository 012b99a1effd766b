// A Cholesky factor that is kept while it is worth keeping: the preconditioner of every linear
// solve.
#pragma once

#include <Eigen/Core>
#include <array>
#include <cmath>
#include <memory>
#include <vector>

#include "cloth/assembly.hpp"
#include "cloth/numbering.hpp"
#include "cloth/problem.hpp"
#include "cloth/settings.hpp"
#include "contact/contact_set.hpp"
#include "contact/state.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// The arrays behind the multifrontal factor: which rows each front has, and what of the matrix goes
// into it.
struct FactorStorage {
  // Fronts that are made anew together, by one of them: a small subtree by its root, a large front
  // by itself. What waits of it for the parent is kept, so that the parent can be made anew without
  // it.
  std::vector<int> piece;
  std::vector<char> due;
  std::vector<double> work;  // of each front, flops
  std::vector<int> pivot_begin, row_begin, rows, child_begin, children, run_begin;
  std::vector<int> entry_slot, entry_block, entry_row, entry_column;
  std::vector<FrontRun> runs;
  std::vector<long> tile_begin, entry_begin, update_begin;
  Buffer<float> tiles, panel, updates, local;
  long local_floats = 0;  // of one right-hand side in `local`

  // Patterns in the numbers of the order of elimination; that of bending holds that of the
  // membrane.
  FactorStorage(const Pattern& bending, const Pattern& membrane, const Dissection& dissection);

  Factor view(bool half);

  // Marks fronts as due: all of them, or those pieces in which `touched` (free nodes) is set, and
  // what they lead to. The latter returns their share of the work.
  void mark_all();
  double mark(const std::vector<char>& touched);
};

// Whether a factor was made, for steps of which length, and GMRES iterations that it has cost
// since.
class FactorAge {
 public:
  void restart(double dt) { dt_ = dt, fresh_ = -1, last_ = excess_ = 0; }
  void forget() { dt_ = 0.0; }
  bool exists() const { return dt_ > 0.0; }
  // Whether it is for steps of this length.
  bool fits(double dt) const { return exists() && std::abs(dt - dt_) <= 1e-9 * dt_; }
  void spent(int iterations);
  // Whether a new one would have cost less, or may help.
  bool too_much(const ClothSettings& settings) const {
    return excess_ > settings.refactor_after || last_ >= krylov_max;
  }

 private:
  double dt_ = 0.0;                         // s; 0: there is none
  int last_ = 0, fresh_ = -1, excess_ = 0;  // of the last solve, of the first, and beyond that
};

class StaleFactor {
 public:
  explicit StaleFactor(const Numbering& numbering);
  StaleFactor(const StaleFactor&) = delete;

  FactorAge age;

  const Factor& view() const { return view_; }
  // Makes it anew if it never was made or has cost more GMRES iterations than a new one would;
  // where it is of other contacts, those parts that hold them. Returns the share that was made.
  double renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, double dt,
               const ClothSettings& settings);
  void make(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, double dt);

 private:
  void refresh(const Assembly& assembly, const ContactState& contact);

  FactorStorage storage_;
  Factor view_;
  // Without contact. Parts are made anew of the same: of one that moved on they would not fit the
  // others.
  ClothMatrix matrix_{};
  NeighbourNumbers numbers_;
  Buffer<float> added_;
  std::vector<int> modes_;     // that it was made for
  std::vector<char> touched_;  // nodes whose modes are others now
};

// Factors for the lengths of step of late: a length that recurs is not factored again.
class FactorPool {
 public:
  explicit FactorPool(const Numbering& numbering);

  // That for steps of dt, or one to be made in place of the one that was needed least recently.
  StaleFactor& of(double dt);
  StaleFactor& latest() { return *factors_.front(); }

 private:
  std::vector<std::unique_ptr<StaleFactor>> factors_;  // the latest first
  const Numbering& numbering_;
};

// The preconditioner while pairs are active (pair_factor.cpp): a factor with an order of its own,
// by nested dissection in the space where the cloth is. In the plane at rest, layers of a fold
// would couple everywhere. Nodes that stick to bodies couple nothing: sheets that lie on a floor do
// not hang together through it.
class PairFactor {
 public:
  PairFactor() = default;
  PairFactor(const PairFactor&) = delete;

  FactorAge age;

  const Factor& view() const { return view_; }

  // Makes it anew if it is of another length of step or has cost more GMRES iterations than a new
  // one would; where too many nodes are held otherwise by pairs and bodies, those parts that hold
  // them. Returns the share that was made.
  double renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact,
               const ContactSet& pairs, double dt, const ClothSettings& settings);

 private:
  // An active pair: w_a w_b symmetric for each two of its nodes, which are -1 where they are held
  // or pinned.
  struct Entry {
    std::array<int, 4> node;
    std::array<float, 4> weight;
    Eigen::Matrix3f symmetric;
  };
  using Hold = Eigen::Matrix<float, 6, 1>;  // xx xy xz yy yz zz, N/m

  void collect(const ContactSet& pairs, int free_nodes);
  int compare(const Assembly& assembly, const ContactState& contact);
  int missing(const ContactState& contact) const;
  Graph graph_of(const Pattern& pattern) const;
  Dissection dissect(const Graph& bending, const Buffer<double>& x) const;
  std::vector<std::array<int, 2>> slots_of(const Pattern& from, const Pattern& to,
                                           bool lower) const;
  void order(const Assembly& assembly, const Buffer<double>& x, const ContactState& contact,
             const ContactSet& pairs);
  void enter(bool whole);
  void read_matrix(Assembly& assembly, const Buffer<double>& x);
  void make(const Assembly& assembly);
  static void add_holds(const Entry& entry, std::vector<Hold>& holds);
  bool has_place(const Entry& entry) const;
  // Calls with the slot of each two of its nodes, and the product of their weights.
  template <class Call>
  void visit(const Entry& entry, const Call& call) const;

  std::vector<int> order_, place_;  // nodes by place, and back
  std::vector<char> pinned_;        // nodes that stuck when the order was made
  Pattern bending_, membrane_;      // in places; both have those of pairs
  std::unique_ptr<FactorStorage> storage_;
  Factor view_{};
  ClothMatrix matrix_{};
  NeighbourNumbers numbers_;
  Buffer<float> scalars_, blocks_, diagonal_, added_, ordered_;
  std::vector<std::array<int, 2>> scalar_slots_,
      block_slots_;                          // of the assembly's entries, and here
  std::vector<Entry> wanted_, entries_;      // entries_: those in the factor
  std::vector<Hold> bodies_, holds_, held_;  // of nodes, by bodies; with wanted_; in the factor
  std::vector<char> touched_, due_;
};

}  // namespace sim_core
