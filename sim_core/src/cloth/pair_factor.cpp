#include <algorithm>

#include "cloth/constants.hpp"
#include "cloth/factor.hpp"

namespace sim_core {
namespace {

// Pinned nodes in a front.
constexpr std::size_t pins_together = tile_columns / 3;

}  // namespace

double PairFactor::renew(Assembly& assembly, const Buffer<double>& x, const ContactState& contact,
                         const ContactSet& pairs, double dt, const ClothSettings& settings) {
  collect(pairs, assembly.numbering.free_nodes);
  const int changed = compare(assembly, contact);
  const double count = static_cast<double>(wanted_.size());
  // Under a smoothed law all pairs change all the time.
  bool whole = pairs.smoothing > 0.0 || !age.fits(dt) || age.too_much(settings);
  if (!whole && !(changed > factors::changed_fraction * count)) return 0.0;
  if (!age.exists() || missing(contact) > factors::missing_fraction * count) {
    order(assembly, x, contact, pairs);
    compare(assembly, contact);
    whole = true;
  }
  enter(whole);
  double fraction = 1.0;
  if (whole) {
    read_matrix(assembly, x);
    storage_->mark_all();
    age.restart(dt);
  } else {
    for (std::size_t i = 0; i < touched_.size(); ++i) due_[place_[i]] = touched_[i];
    fraction = storage_->mark(due_);
  }
  make(assembly);
  return fraction;
}

void PairFactor::collect(const ContactSet& pairs, int free_nodes) {
  wanted_.clear();
  for (const Pair& pair : pairs.list()) {
    if (!pair.active()) continue;
    Entry entry;
    for (int c = 0; c < 4; ++c) {
      const int node = pair.stencil.node[c];
      entry.node[c] = node < free_nodes && (pinned_.empty() || !pinned_[node]) ? node : -1;
      entry.weight[c] = static_cast<float>(pair.weights[c]);
    }
    entry.symmetric = pair.row.symmetric.cast<float>();
    wanted_.push_back(entry);
  }
}

// Marks the nodes that are held otherwise than in the factor, and returns how many there are.
int PairFactor::compare(const Assembly& assembly, const ContactState& contact) {
  const std::size_t free_nodes = contact.mode.size();
  bodies_.resize(free_nodes);
  held_.resize(free_nodes, Hold::Zero());
  touched_.assign(free_nodes, 0);
  due_.resize(free_nodes);
  for (std::size_t i = 0; i < free_nodes; ++i) {
    const int node = static_cast<int>(i);
    bodies_[i].setZero();
    if (contact.mode[i] != contact_open)
      contact.factor_block(node, assembly.own_stiffness(node), bodies_[i].data());
  }
  holds_ = bodies_;
  for (const Entry& entry : wanted_) add_holds(entry, holds_);
  const float hold_change = static_cast<float>(factors::hold_change);
  const float hold_min = static_cast<float>(factors::hold_min);
  int changed = 0;
  for (std::size_t i = 0; i < free_nodes; ++i) {
    const float difference = (holds_[i] - held_[i]).squaredNorm();
    if (difference == 0.0f) continue;
    const float least = hold_min * static_cast<float>(assembly.own_stiffness(static_cast<int>(i)));
    const float most =
        std::max({hold_change * hold_change * holds_[i].squaredNorm(),
                  hold_change * hold_change * held_[i].squaredNorm(), least * least});
    if (difference > most) touched_[i] = 1, ++changed;
  }
  return changed;
}

// Pairs that have no place in the pattern, and nodes that are pinned but stick no more.
int PairFactor::missing(const ContactState& contact) const {
  int count = 0;
  for (const Entry& entry : wanted_) count += !has_place(entry);
  for (std::size_t i = 0; i < pinned_.size(); ++i)
    count += pinned_[i] && contact.mode[i] != contact_stick;
  return count;
}

void PairFactor::add_holds(const Entry& entry, std::vector<Hold>& holds) {
  const Eigen::Matrix3f& k = entry.symmetric;
  const Hold whole{k(0, 0), k(0, 1), k(0, 2), k(1, 1), k(1, 2), k(2, 2)};
  for (int c = 0; c < 4; ++c) {
    if (entry.node[c] >= 0) holds[entry.node[c]] += entry.weight[c] * entry.weight[c] * whole;
  }
}

template <class Call>
void PairFactor::visit(const Entry& entry, const Call& call) const {
  for (int a = 0; a < 4; ++a) {
    for (int b = 0; b < a; ++b) {
      if (entry.node[a] < 0 || entry.node[b] < 0 || entry.weight[a] * entry.weight[b] == 0.0f)
        continue;
      const auto [low, high] = std::minmax(place_[entry.node[a]], place_[entry.node[b]]);
      call(membrane_.slot(high, low), entry.weight[a] * entry.weight[b]);
    }
  }
}

bool PairFactor::has_place(const Entry& entry) const {
  bool all = true;
  visit(entry, [&](int slot, float) { all = all && slot >= 0; });
  return all;
}

// Which loose nodes a pattern or an active pair couples. Pinned nodes are coupled to themselves
// only.
Graph PairFactor::graph_of(const Pattern& pattern) const {
  Graph graph(pinned_.size());
  for (std::size_t i = 0; i < pinned_.size(); ++i) {
    if (pinned_[i]) {
      graph[i] = {static_cast<int>(i)};
      continue;
    }
    for (int e = pattern.begin[i]; e < pattern.begin[i + 1]; ++e) {
      if (!pinned_[pattern.node[e]]) graph[i].push_back(pattern.node[e]);
    }
  }
  for (const Entry& entry : wanted_) {
    for (int a : entry.node) {
      for (int b : entry.node) {
        if (a >= 0 && b >= 0) graph[a].push_back(b);
      }
    }
  }
  for (std::vector<int>& row : graph) {
    std::sort(row.begin(), row.end());
    row.erase(std::unique(row.begin(), row.end()), row.end());
  }
  return graph;
}

// Of the loose nodes, where they are in space. Pinned nodes come last, a few in a front.
Dissection PairFactor::dissect(const Graph& bending, const Buffer<double>& x) const {
  std::vector<int> loose, pins, number(pinned_.size(), -1);
  for (std::size_t i = 0; i < pinned_.size(); ++i) {
    number[i] = static_cast<int>(loose.size());
    (pinned_[i] ? pins : loose).push_back(static_cast<int>(i));
  }
  Graph coupled(loose.size());
  Eigen::MatrixXd points(loose.size(), 3);
  for (std::size_t l = 0; l < loose.size(); ++l) {
    for (int j : bending[loose[l]]) coupled[l].push_back(number[j]);
    points.row(static_cast<Eigen::Index>(l)) = at_node(x, loose[l]).transpose();
  }
  Dissection dissection = nested_dissection(coupled, points);
  for (int& i : dissection.order) i = loose[i];
  for (std::size_t p = 0; p < pins.size(); ++p) {
    dissection.order.push_back(pins[p]);
    if ((p + 1) % pins_together != 0 && p + 1 < pins.size()) continue;
    dissection.pivot_begin.push_back(static_cast<int>(dissection.order.size()));
    dissection.parent.push_back(-1);
  }
  return dissection;
}

// Where the entries of the assembly's pattern stand in one of places: those in the rows of the node
// that is eliminated first, or with `lower` in those of the other.
std::vector<std::array<int, 2>> PairFactor::slots_of(const Pattern& from, const Pattern& to,
                                                     bool lower) const {
  std::vector<std::array<int, 2>> slots;
  for (int i = 0; i < from.rows(); ++i) {
    for (int e = from.begin[i]; e < from.begin[i + 1]; ++e) {
      const int row = place_[i], column = place_[from.node[e]];
      if (lower ? column > row : column < row) continue;
      const int slot = to.slot(row, column);
      if (slot >= 0) slots.push_back({e, slot});
    }
  }
  return slots;
}

void PairFactor::order(const Assembly& assembly, const Buffer<double>& x,
                       const ContactState& contact, const ContactSet& pairs) {
  const Numbering& numbering = assembly.numbering;
  const int free_nodes = numbering.free_nodes;
  pinned_.resize(free_nodes);
  for (int i = 0; i < free_nodes; ++i) pinned_[i] = contact.mode[i] == contact_stick;
  collect(pairs, free_nodes);
  const Graph bending = graph_of(numbering.compact_bending),
              membrane = graph_of(numbering.membrane);
  const Dissection dissection = dissect(bending, x);
  order_ = dissection.order;
  place_.resize(free_nodes);
  for (int i = 0; i < free_nodes; ++i) place_[order_[i]] = i;
  bending_ = renumbered(bending, order_, place_);
  membrane_ = renumbered(membrane, order_, place_);
  // The factor reads a scalar in the row of the one that is eliminated first, and a block in that
  // of the other.
  scalar_slots_ = slots_of(numbering.compact_bending, bending_, false);
  block_slots_ = slots_of(numbering.membrane, membrane_, true);
  scalars_.assign(bending_.node.size(), 0.0f);
  blocks_.assign(12 * membrane_.node.size(), 0.0f);
  diagonal_.resize(free_nodes);
  added_.resize(6L * free_nodes);
  storage_ = std::make_unique<FactorStorage>(bending_, membrane_, dissection);
  ordered_.assign(solve_group * 4L * free_nodes + 64, 0.0f);
  view_ = storage_->view(false);  // half precision takes 2 to 20 times the iterations in a crumple
  view_.order = order_.data();
  view_.ordered = ordered_.data();
}

// Pairs at nodes that are held otherwise go, and those that are wanted there come, so that what is
// in the factor stays that of some pairs, and positive.
void PairFactor::enter(bool whole) {
  if (whole) {
    entries_.clear();
    std::fill(touched_.begin(), touched_.end(), 1);
  }
  std::fill(due_.begin(), due_.end(), 0);
  const auto meets = [&](const Entry& entry) {
    if (std::none_of(entry.node.begin(), entry.node.end(),
                     [&](int i) { return i >= 0 && touched_[i]; }))
      return false;
    for (int i : entry.node) {
      if (i >= 0) due_[i] = 1;
    }
    return true;
  };
  entries_.erase(std::remove_if(entries_.begin(), entries_.end(), meets), entries_.end());
  for (const Entry& entry : wanted_) {
    if (has_place(entry) && meets(entry)) entries_.push_back(entry);
  }
  for (std::size_t i = 0; i < touched_.size(); ++i) {
    touched_[i] = touched_[i] || due_[i];
    if (touched_[i]) held_[i] = bodies_[i];
  }
  holds_.assign(held_.size(), Hold::Zero());
  for (const Entry& entry : entries_) add_holds(entry, holds_);
  for (std::size_t i = 0; i < touched_.size(); ++i) {
    if (touched_[i]) held_[i] += holds_[i];
  }
}

// The matrix's neighbour, which parts are made anew of, too: of one that moved on they would not
// fit the others.
void PairFactor::read_matrix(Assembly& assembly, const Buffer<double>& x) {
  matrix_ = assembly.neighbour(x, numbers_);
  for (const auto& [from, to] : scalar_slots_) scalars_[to] = matrix_.bending[from];
  for (const auto& [from, to] : block_slots_)
    std::copy_n(matrix_.membrane + 12L * from, 12, &blocks_[12L * to]);
  for (std::size_t i = 0; i < place_.size(); ++i) diagonal_[place_[i]] = matrix_.diagonal[i];
  matrix_.bending = scalars_.data();
  matrix_.membrane = blocks_.data();
  matrix_.diagonal = diagonal_.data();
}

// With bodies as penalties, and the symmetric part of the pairs.
void PairFactor::make(const Assembly& assembly) {
  std::vector<std::pair<int, std::array<float, 12>>> before;
  for (const Entry& entry : entries_) {
    visit(entry, [&](int slot, float weight) {
      float* block = &blocks_[12L * slot];
      before.emplace_back(slot, std::array<float, 12>{});
      std::copy_n(block, 12, before.back().second.data());
      for (int c = 0; c < 3; ++c) {
        for (int r = 0; r < 3; ++r) block[4 * c + r] += weight * entry.symmetric(r, c);
      }
    });
  }
  for (std::size_t i = 0; i < place_.size(); ++i)
    std::copy_n(held_[i].data(), 6, &added_[6L * place_[i]]);
  assembly.kernel.factor(view_, matrix_, added_.data());
  for (auto b = before.rbegin(); b != before.rend(); ++b)
    std::copy_n(b->second.data(), 12, &blocks_[12L * b->first]);
}

}  // namespace sim_core
