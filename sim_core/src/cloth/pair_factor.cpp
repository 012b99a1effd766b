#include "cloth/pair_factor.hpp"

#include <algorithm>
#include <cmath>
#include <set>

namespace sim_core {
namespace {

// Share of the pairs and contacts that may be others than those the factor is of.
constexpr double changed_share = 0.2;

}  // namespace

bool PairFactor::renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, const Pairs& pairs,
                       double dt, const ClothSettings& settings) {
  std::vector<Name> names;
  for (const Pair& pair : pairs.list()) {
    if (pair.bears()) names.push_back({pair.who.kind, pair.who.first, pair.feature, pair.row.mode, pair.insistence});
  }
  const bool stale = !made_ || pairs.smoothing > 0.0 || std::abs(dt - dt_) > 1e-9 * dt_ || excess_ > settings.refactor_after ||
                     last_ >= settings.krylov_max ||
                     changed(contact, names) > changed_share * static_cast<double>(names.size());
  if (!stale) return false;
  if (!made_ || !has_place_for(pairs, assembly.numbering.free_nodes)) order(assembly, x, pairs);
  fill(assembly, x, contact, pairs);
  made_ = true;
  dt_ = dt;
  names_ = std::move(names);
  modes_ = contact.mode;
  excess_ = fresh_ = -1;
  last_ = 0;
  return true;
}

void PairFactor::spent(int iterations) {
  last_ = iterations;
  if (fresh_ < 0) fresh_ = last_, excess_ = 0;
  excess_ += std::max(0, last_ - fresh_);
}

int PairFactor::changed(const ContactState& contact, const std::vector<Name>& names) const {
  int count = 0;
  for (std::size_t i = 0; i < modes_.size(); ++i) count += contact.mode[i] != modes_[i];
  std::vector<Name> others;
  std::set_symmetric_difference(names.begin(), names.end(), names_.begin(), names_.end(), std::back_inserter(others));
  return count + static_cast<int>(others.size());
}

bool PairFactor::has_place_for(const Pairs& pairs, int free_nodes) const {
  for (const Pair& pair : pairs.list()) {
    if (!pair.bears()) continue;
    for (int a : pair.who.node) {
      for (int b : pair.who.node) {
        if (a < free_nodes && b < free_nodes && pattern_.slot(place_[a], place_[b]) < 0) return false;
      }
    }
  }
  return true;
}

void PairFactor::order(const Assembly& assembly, const Buffer<double>& x, const Pairs& pairs) {
  const Numbering& numbering = assembly.numbering;
  const int free_nodes = numbering.free_nodes;
  const Pattern &bending = numbering.compact_bending, &membrane = numbering.membrane;
  Graph graph(free_nodes);
  Eigen::MatrixXd points(free_nodes, 3);
  for (int i = 0; i < free_nodes; ++i) {
    graph[i].assign(bending.node.begin() + bending.begin[i], bending.node.begin() + bending.begin[i + 1]);
    points.row(i) = at_node(x, i).transpose();
  }
  for (const Pair& pair : pairs.list()) {
    if (!pair.bears()) continue;
    for (int a : pair.who.node) {
      for (int b : pair.who.node) {
        if (a < free_nodes && b < free_nodes) graph[a].push_back(b);
      }
    }
  }
  for (std::vector<int>& row : graph) {
    std::sort(row.begin(), row.end());
    row.erase(std::unique(row.begin(), row.end()), row.end());
  }
  const Dissection dissection = nested_dissection(graph, points);
  order_ = dissection.order;
  place_.assign(free_nodes, 0);
  for (int i = 0; i < free_nodes; ++i) place_[order_[i]] = i;
  pattern_ = {};
  for (int i : order_) {
    std::vector<int> row;
    for (int j : graph[i]) row.push_back(place_[j]);
    std::sort(row.begin(), row.end());
    pattern_.add_row(row);
  }
  const auto slots_of = [&](const Pattern& from) {
    std::vector<int> slots;
    for (int i = 0; i < free_nodes; ++i) {
      for (int e = from.begin[i]; e < from.begin[i + 1]; ++e) {
        slots.push_back(pattern_.slot(place_[i], place_[from.node[e]]));
      }
    }
    return slots;
  };
  scalar_slot_ = slots_of(bending);
  block_slot_ = slots_of(membrane);
  storage_ = std::make_unique<FactorStorage>(pattern_, pattern_, dissection);
  ordered_.assign(4L * free_nodes + 64, 0.0f);
  view_ = storage_->view();
  view_.order = order_.data();
  view_.ordered = ordered_.data();
}

// The matrix's neighbour, bodies as penalties, and the symmetric part of the pairs.
void PairFactor::fill(Assembly& assembly, const Buffer<double>& x, const ContactState& contact, const Pairs& pairs) {
  const int free_nodes = assembly.numbering.free_nodes;
  NeighbourNumbers numbers;
  const ClothMatrix neighbour = assembly.neighbour(x, numbers);
  scalars_.assign(pattern_.node.size(), 0.0f);
  blocks_.assign(12 * pattern_.node.size(), 0.0f);
  for (std::size_t e = 0; e < scalar_slot_.size(); ++e) scalars_[scalar_slot_[e]] = neighbour.bending[e];
  for (std::size_t e = 0; e < block_slot_.size(); ++e) {
    std::copy_n(neighbour.membrane + 12 * e, 12, &blocks_[12L * block_slot_[e]]);
  }
  for (const Pair& pair : pairs.list()) {
    if (!pair.bears()) continue;
    for (int a = 0; a < 4; ++a) {
      for (int b = 0; b < 4; ++b) {
        if (pair.who.node[a] >= free_nodes || pair.who.node[b] >= free_nodes) continue;
        const int slot = pattern_.slot(place_[pair.who.node[a]], place_[pair.who.node[b]]);
        const Eigen::Matrix3f block = (pair.weights[a] * pair.weights[b] * pair.row.symmetric).cast<float>();
        for (int c = 0; c < 3; ++c) {
          for (int r = 0; r < 3; ++r) blocks_[12L * slot + 4 * c + r] += block(r, c);
        }
      }
    }
  }
  diagonal_.resize(free_nodes);
  added_.assign(6L * free_nodes, 0.0f);
  for (int i = 0; i < free_nodes; ++i) {
    diagonal_[place_[i]] = neighbour.diagonal[i];
    contact.penalty(i, assembly.own_stiffness(i), &added_[6L * place_[i]]);
  }
  ClothMatrix ordered = neighbour;
  ordered.bending = scalars_.data();
  ordered.membrane = blocks_.data();
  ordered.diagonal = diagonal_.data();
  storage_->mark_all();
  assembly.kernel.factor(view_, ordered, {added_.data()});
}

}  // namespace sim_core
