// The preconditioner while pairs bear: a factor with an order of its own, by nested dissection in the space where the
// cloth is. In the plane at rest, layers of a fold would couple everywhere.
#pragma once

#include <memory>
#include <tuple>
#include <vector>

#include "cloth/assembly.hpp"
#include "cloth/fronts.hpp"
#include "cloth/settings.hpp"
#include "contact/pairs.hpp"
#include "contact/state.hpp"

namespace sim_core {

class PairFactor {
 public:
  PairFactor() = default;
  PairFactor(const PairFactor&) = delete;

  const Factor& view() const { return view_; }

  // Makes it anew where it is of another length of step, of contacts and pairs of which too many are others now, or has
  // cost too many GMRES iterations. Returns whether it did.
  bool renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, const Pairs& pairs, double dt,
             const ClothSettings& settings);
  void spent(int iterations);

 private:
  // A pair that bears: its nodes, and how.
  using Name = std::tuple<PairKind, int, int, int, double>;

  void order(const Assembly& assembly, const Buffer<double>& x, const Pairs& pairs);
  bool has_place_for(const Pairs& pairs, int free_nodes) const;
  void fill(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, const Pairs& pairs);
  int changed(const ContactState& contact, const std::vector<Name>& names) const;

  std::vector<int> order_, place_;  // nodes by place, and back
  Pattern pattern_;
  std::unique_ptr<FactorStorage> storage_;
  Factor view_{};
  Buffer<float> scalars_, blocks_, diagonal_, added_, ordered_;
  std::vector<int> scalar_slot_, block_slot_;  // of the assembly's entries
  std::vector<int> modes_;
  std::vector<Name> names_;
  bool made_ = false;
  double dt_ = 0.0;
  int last_ = 0, fresh_ = -1, excess_ = 0;
};

}  // namespace sim_core
