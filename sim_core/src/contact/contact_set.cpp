#include "contact/contact_set.hpp"

#include <algorithm>
#include <limits>
#include <utility>

namespace sim_core {

using Eigen::Matrix3d;

ContactSet::ContactSet(Surface surface, const ContactMaterials& materials, const ContactSettings& settings,
                       const PathSettings& path, double margin, int free_nodes)
    : settings_(settings),
      free_nodes_(free_nodes),
      detection_(std::move(surface), materials, settings, path, margin, free_nodes) {}

void ContactSet::restart() {
  kept_.clear();
  pairs_.clear();
}

void ContactSet::begin(const Buffer<double>& start, const Buffer<double>& ends, const Buffer<double>& expected,
                       std::vector<Matrix3d> own, std::vector<Matrix3d> bone_turns) {
  detection_.begin(start, ends, expected, std::move(own), std::move(bone_turns));
  base_ = kept_;
}

void ContactSet::keep() {
  kept_.clear();
  for (const Pair& pair : pairs_) {
    if (pair.at.force.isZero(0.0)) continue;
    kept_.emplace_back(pair);
    kept_.back().change.setZero();
    kept_.back().penalty_scale = 1.0;
  }
}

void ContactSet::update(const Buffer<double>& x, double share, Buffer<double>& residual) {
  detection_.find(x, smoothing, stiff, pairs_);
  transfer(share);
  merge();
  linearize_at(x);
  for (const Pair& pair : pairs_) {
    if (pair.at.force.isZero(0.0)) continue;
    for (int c = 0; c < 4; ++c) at_node(residual, pair.who.node[c]) -= pair.weights[c] * pair.at.force;
  }
}

void ContactSet::add_stiffness(double share, std::vector<double>& stiffness) const {
  for (const Pair& pair : pairs_) {
    if (!pair.active()) continue;
    const double own = share * pair.row.symmetric.trace() / (3.0 * pair.penalty_scale);
    for (int c = 0; c < 4; ++c) {
      if (pair.who.node[c] < free_nodes_) stiffness[pair.who.node[c]] += pair.weights[c] * pair.weights[c] * own;
    }
  }
}

void ContactSet::count_errors(double stiffness, Norms& norms) const {
  for (const Pair& pair : pairs_) {
    PairKinematics at = pair.at;
    at.stiffness = stiffness;
    const double error = pair_error_squared(at);
    if (error != 0.0) norms.count(error);
  }
}

bool ContactSet::relevant() const {
  const std::vector<int>& sheet_of_node = detection_.near.surface.sheet_of_node;
  return std::any_of(pairs_.begin(), pairs_.end(), [&](const Pair& pair) {
    const int last = std::max(sheet_of_node[pair.who.node[0]], sheet_of_node[pair.who.node[3]]);
    return pair.active() || last < detection_.materials.sheets;
  });
}

double ContactSet::sharpest() const {
  double out = std::numeric_limits<double>::infinity();
  for (const Pair& pair : pairs_) {
    const Bone* bone = bone_of(pair);
    if (bone && pair.active()) out = std::min(out, bone->radius / materials().cell);
  }
  return out;
}

bool ContactSet::active() const {
  return std::any_of(pairs_.begin(), pairs_.end(),
                     [](const Pair& pair) { return pair.active() || !pair.at.force.isZero(0.0); });
}

double ContactSet::smoothed_force() const {
  double sum = 0.0;
  for (const Pair& pair : pairs_) sum += pair.at.stiffness;
  return pairs_.empty() ? 0.0 : smoothing * sum / static_cast<double>(pairs_.size());
}

void ContactSet::solved(const Buffer<float>& change) {
  for (Pair& pair : pairs_) {
    pair.change = pair.force_change(change, free_nodes_);
    pair.added = pair.released = false;
  }
  base_.assign(pairs_.begin(), pairs_.end());
}

void ContactSet::return_to_best() {
  base_ = best_;
  for (PairPast& pair : base_) pair.change.setZero();
}

}  // namespace sim_core
