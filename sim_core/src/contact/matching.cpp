#include <algorithm>
#include <cmath>
#include <numeric>
#include <tuple>
#include <utility>

#include "contact/constants.hpp"
#include "contact/contact_set.hpp"

namespace sim_core {
namespace {

using Eigen::Vector3d;

template <class Any>
auto key(const Any& pair) {
  return std::make_tuple(pair.stencil.kind, pair.stencil.first, pair.feature);
}

// Whether two pairs have the same vertex, or one of their edges is the same.
bool have_common_piece(const Candidate& a, const Candidate& b) {
  if (a.kind != b.kind) return false;
  if (a.kind == PairKind::vertex_triangle) return a.first == b.first;
  return a.first == b.first || a.second == b.second || a.first == b.second || a.second == b.first;
}

}  // namespace

// Transfers the forces of earlier pairs, with a step length along their last changes, to the pairs
// at hand, both sorted by kind, first and feature.
void ContactSet::transfer(double step_length) {
  std::vector<const PairPast*> orphans;
  std::vector<std::size_t> fresh;
  std::size_t o = 0;
  for (std::size_t i = 0; i < pairs_.size(); ++i) {
    for (; o < base_.size() && key(base_[o]) < key(pairs_[i]); ++o) orphans.push_back(&base_[o]);
    if (o < base_.size() && key(base_[o]) == key(pairs_[i])) {
      inherit(pairs_[i], base_[o], step_length);
      ++o;
    } else {
      fresh.push_back(i);
    }
  }
  for (; o < base_.size(); ++o) orphans.push_back(&base_[o]);
  for (const PairPast* orphan : orphans) {
    const Vector3d force = orphan->force + step_length * orphan->change;
    if (!force.isZero(0.0)) adopt(*orphan, force, fresh);
  }
}

// Gives a pair the force of the same pair before. Under the exact law the proximal stiffness of
// pairs that stall grows: those that stay off by much of what they were off before.
void ContactSet::inherit(Pair& pair, const PairPast& past, double step_length) const {
  pair.contact.force = past.force + step_length * past.change;
  pair.proximal_growth = past.proximal_growth;
  pair.cone = past.cone;
  const double now = violation(pair.contact, past.mode);
  const bool is_exact = smoothing == 0.0 && step_length == 1.0 && past.mode != contact_open;
  const bool was_near =
      past.missed > pairs::length_tolerance && past.missed < pairs::half_layer * pair.thickness;
  if (is_exact && was_near && now > pairs::converging * past.missed)
    pair.proximal_growth =
        std::min(stiffness::growth * past.proximal_growth, stiffness::growth_max);
  pair.proximal.normal *= pair.proximal_growth;
  pair.proximal.tangential *= pair.proximal_growth;
}

// The force of a pair that is gone goes to the new pair of the same vertex, or of one of its edges,
// whose normal is most alike: the closest feature has changed. Else it goes to the nearest pair.
void ContactSet::adopt(const PairPast& orphan, const Vector3d& force,
                       const std::vector<std::size_t>& fresh) {
  Pair* match = nullptr;
  double most_alike = pairs::match_cosine;
  for (std::size_t i : fresh) {
    if (!have_common_piece(pairs_[i].stencil, orphan.stencil)) continue;
    const double alike = pairs_[i].contact.normal.dot(orphan.normal);
    if (alike > most_alike) most_alike = alike, match = &pairs_[i];
  }
  if (match) {
    match->contact.force += force;
    return;
  }
  double nearest = pairs::half_layer * orphan.thickness;
  for (Pair& pair : pairs_) {
    const double far = (pair.middle - orphan.middle).norm();
    const double alike = pair.contact.normal.dot(orphan.normal);
    if (far < nearest && std::abs(alike) > pairs::match_cosine) nearest = far, match = &pair;
  }
  if (!match) return;
  const bool has_same_side = match->contact.normal.dot(orphan.normal) > 0.0;
  match->contact.force += has_same_side ? force : Vector3d(-force);
}

// Merges pairs at nearly the same place, as where a vertex lies on a vertex: their rows differ by
// rounding only and would contradict each other. The pair that stays has the larger distance to
// keep, then a force, then the smaller gap; it takes the forces of the others.
void ContactSet::merge() {
  const std::size_t count = pairs_.size();
  const Vector3d across(0.62, 0.55, 0.56);  // along no edge of a mesh that is aligned with the axes
  std::vector<std::pair<double, std::size_t>> line(count);
  for (std::size_t i = 0; i < count; ++i) line[i] = {across.dot(pairs_[i].middle), i};
  std::sort(line.begin(), line.end());
  std::vector<std::size_t> place(count), order(count);
  for (std::size_t l = 0; l < count; ++l) place[line[l].second] = l;
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::vector<std::tuple<bool, bool, double>> rank(
      count);  // whether it keeps less apart, has no force; its gap
  for (std::size_t i = 0; i < count; ++i) {
    const auto sheet = [&](int c) { return near.surface.sheet_of_node[pairs_[i].stencil.node[c]]; };
    rank[i] = {pairs_[i].thickness < materials.rest_distance(sheet(0), sheet(3)),
               pairs_[i].contact.force.isZero(0.0), pairs_[i].contact.gap};
  }
  std::stable_sort(order.begin(), order.end(),
                   [&](std::size_t a, std::size_t b) { return rank[a] < rank[b]; });
  std::vector<char> gone(count, 0);
  for (std::size_t i : order) {
    if (gone[i]) continue;
    const double radius = pairs::merge_radius * pairs_[i].thickness;
    const auto take = [&](std::size_t j) {
      if (gone[j] || (pairs_[j].middle - pairs_[i].middle).squaredNorm() > radius * radius) return;
      const Vector3d& force = pairs_[j].contact.force;
      pairs_[i].contact.force +=
          pairs_[i].contact.normal.dot(pairs_[j].contact.normal) > 0.0 ? force : Vector3d(-force);
      gone[j] = 1;
    };
    const double reach = 1.01 * radius;
    for (std::size_t l = place[i]; l-- > 0 && line[place[i]].first - line[l].first < reach;)
      take(line[l].second);
    for (std::size_t l = place[i] + 1; l < count && line[l].first - line[place[i]].first < reach;
         ++l)
      take(line[l].second);
  }
  std::size_t i = 0;
  std::erase_if(pairs_, [&](const Pair&) { return gone[i++] != 0; });
}

bool ContactSet::has_static(const Pair& pair) const {
  const std::vector<int>& sheet_of_node = near.surface.sheet_of_node;
  return materials.has_static(sheet_of_node[pair.stencil.node[0]],
                              sheet_of_node[pair.stencil.node[3]]);
}

// Slip by which velocities lead, m.
Vector3d ContactSet::expected_slip(const Pair& pair) {
  const Vector3d way = between_closest(pair.weights, points_of(pair.stencil, expected_)) -
                       turn_of(pair.stencil, pair.weights) *
                           between_closest(pair.weights, points_of(pair.stencil, *start_));
  const Vector3d& n = pair.contact.normal;
  return way - way.dot(n) * n;
}

// That of the same pair at the start of the step, or else of one that had a piece of it.
Cone ContactSet::cone_at_start(const Pair& pair) {
  const PairPast* match = nullptr;
  double most_alike = pairs::match_cosine;
  for (const PairPast& past : ended_) {
    if (key(past) == key(pair)) return *past.cone;
    if (!have_common_piece(past.stencil, pair.stencil)) continue;
    const double alike = pair.contact.normal.dot(past.normal);
    if (alike > most_alike) most_alike = alike, match = &past;
  }
  return match ? *match->cone : cone_of_new(expected_slip(pair));
}

void ContactSet::choose_cones() {
  const std::vector<int>& sheet_of_node = near.surface.sheet_of_node;
  for (Pair& pair : pairs_) {
    if (!has_static(pair)) continue;
    if (!pair.cone) pair.cone = cone_at_start(pair);
    pair.contact.mu = materials.friction(sheet_of_node[pair.stencil.node[0]],
                                         sheet_of_node[pair.stencil.node[3]], *pair.cone);
  }
}

bool ContactSet::switch_cones() {
  bool any = false;
  if (!has_static_) return any;
  for (Pair& pair : pairs_) {
    if (!pair.cone || !has_static(pair)) continue;
    const Cone next =
        next_cone(*pair.cone, pair.row.mode, pair.contact.slip.dot(expected_slip(pair)));
    any = any || next != *pair.cone;
    pair.cone = next;
  }
  if (!any) return any;
  mark_best();
  return_to_best();
  return any;
}

}  // namespace sim_core
