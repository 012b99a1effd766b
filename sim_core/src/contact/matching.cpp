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

}  // namespace

// Transfers the forces of earlier pairs, with a share of their last changes, to the pairs at hand,
// both sorted by kind, first and feature. The force of a pair that is gone goes to the new pair of
// the same vertex, or of one of its edges, whose normal is most alike: the closest feature has
// changed; else to the nearest pair. Under the exact law the proximal stiffness of pairs that stall
// grows.
void ContactSet::transfer(double share) {
  std::vector<const PairPast*> orphans;
  std::vector<std::size_t> fresh;
  std::size_t o = 0;
  for (std::size_t i = 0; i < pairs_.size(); ++i) {
    for (; o < base_.size() && key(base_[o]) < key(pairs_[i]); ++o) orphans.push_back(&base_[o]);
    if (o < base_.size() && key(base_[o]) == key(pairs_[i])) {
      pairs_[i].contact.force = base_[o].force + share * base_[o].change;
      pairs_[i].penalty_scale = base_[o].penalty_scale;
      const int mode = base_[o].mode;
      const double last = base_[o].missed, now = violation(pairs_[i].contact, mode);
      if (smoothing == 0.0 && share == 1.0 && mode != contact_open &&
          last > pairs::length_tolerance && last < pairs::half_layer * pairs_[i].thickness &&
          now > pairs::converging * last) {
        pairs_[i].penalty_scale =
            std::min(stiffness::growth * base_[o].penalty_scale, stiffness::growth_max);
      }
      pairs_[i].proximal.normal *= pairs_[i].penalty_scale;
      pairs_[i].proximal.tangential *= pairs_[i].penalty_scale;
      ++o;
    } else {
      fresh.push_back(i);
    }
  }
  for (; o < base_.size(); ++o) orphans.push_back(&base_[o]);
  for (const PairPast* orphan : orphans) {
    const Vector3d force = orphan->force + share * orphan->change;
    if (force.isZero(0.0)) continue;
    std::size_t match = pairs_.size();
    double best = pairs::match_cosine;
    for (std::size_t i : fresh) {
      const Candidate &a = pairs_[i].stencil, &b = orphan->stencil;
      if (a.kind != b.kind) continue;
      const bool common = a.kind == PairKind::vertex_triangle
                              ? a.first == b.first
                              : a.first == b.first || a.second == b.second || a.first == b.second ||
                                    a.second == b.first;
      if (!common) continue;
      const double alike = pairs_[i].contact.normal.dot(orphan->normal);
      if (alike > best) best = alike, match = i;
    }
    if (match < pairs_.size()) {
      pairs_[match].contact.force += force;
      continue;
    }
    best = pairs::half_layer * orphan->thickness;
    for (std::size_t i = 0; i < pairs_.size(); ++i) {
      const double far = (pairs_[i].middle - orphan->middle).norm();
      const double alike = pairs_[i].contact.normal.dot(orphan->normal);
      if (far < best && std::abs(alike) > pairs::match_cosine) best = far, match = i;
    }
    if (match < pairs_.size()) {
      pairs_[match].contact.force +=
          pairs_[match].contact.normal.dot(orphan->normal) > 0.0 ? force : Vector3d(-force);
    }
  }
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

}  // namespace sim_core
