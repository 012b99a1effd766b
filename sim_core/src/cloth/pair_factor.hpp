// The preconditioner while pairs are active: a factor with an order of its own, by nested dissection in the space where
// the cloth is. In the plane at rest, layers of a fold would couple everywhere. Nodes that stick to bodies couple
// nothing: sheets that lie on a floor do not hang together through it.
#pragma once

#include <Eigen/Core>
#include <array>
#include <memory>
#include <vector>

#include "cloth/assembly.hpp"
#include "cloth/factor.hpp"
#include "cloth/settings.hpp"
#include "contact/contact_set.hpp"
#include "contact/state.hpp"

namespace sim_core {

class PairFactor {
 public:
  explicit PairFactor(const FactorSettings& constants) : constants_(constants) {}
  PairFactor(const PairFactor&) = delete;

  const Factor& view() const { return view_; }

  // Makes it anew if it is of another length of step or has cost more GMRES iterations than a new one would; where too
  // many nodes are held otherwise by pairs and bodies, those parts that hold them. Returns the share that was made.
  double renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, const ContactSet& pairs,
               double dt, const ClothSettings& settings);
  void spent(int iterations) { cost_.spent(iterations); }

 private:
  // An active pair: w_a w_b stiffness for each two of its nodes, which are -1 where they are held or pinned.
  struct Entry {
    std::array<int, 4> node;
    std::array<float, 4> weight;
    Eigen::Matrix3f stiffness;
  };
  using Hold = Eigen::Matrix<float, 6, 1>;  // xx xy xz yy yz zz, N/m

  void collect(const ContactSet& pairs, int free_nodes);
  int compare(const Assembly& assembly, const ContactState& contact);
  int missing(const ContactState& contact) const;
  void order(const Assembly& assembly, const Buffer<double>& x, const ContactState& contact, const ContactSet& pairs);
  void enter(bool whole);
  void read_matrix(Assembly& assembly, const Buffer<double>& x);
  void make(const Assembly& assembly);
  static void add_holds(const Entry& entry, std::vector<Hold>& holds);
  bool has_place(const Entry& entry) const;
  // Calls with the slot of each two of its nodes, and the product of their weights.
  template <class Call>
  void visit(const Entry& entry, const Call& call) const;

  FactorSettings constants_;
  std::vector<int> order_, place_;  // nodes by place, and back
  std::vector<char> pinned_;        // nodes that stuck when the order was made
  Pattern bending_, membrane_;      // in places; both have those of pairs
  std::unique_ptr<FactorStorage> storage_;
  Factor view_{};
  ClothMatrix matrix_{};
  NeighbourNumbers numbers_;
  Buffer<float> scalars_, blocks_, diagonal_, added_, ordered_;
  std::vector<std::array<int, 2>> scalar_slots_, block_slots_;  // of the assembly's entries, and here
  std::vector<Entry> wanted_, entries_;                         // entries_: those in the factor
  std::vector<Hold> bodies_, holds_, held_;                     // of nodes, by bodies; with wanted_; in the factor
  std::vector<char> touched_, due_;
  bool made_ = false;
  double dt_ = 0.0;
  FactorCost cost_;
};

}  // namespace sim_core
