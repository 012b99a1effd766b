#include "contact/matching.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <tuple>
#include <utility>

namespace sim_core {
namespace {

using Eigen::Vector3d;

template <class Any>
auto key(const Any& pair) {
  return std::make_tuple(pair.who.kind, pair.who.first, pair.feature);
}

}  // namespace

void transfer(std::vector<Pair>& pairs, const std::vector<PairPast>& before, double share, bool exact,
              const ContactSettings& settings) {
  std::vector<const PairPast*> orphans;
  std::vector<std::size_t> fresh;
  std::size_t o = 0;
  for (std::size_t i = 0; i < pairs.size(); ++i) {
    for (; o < before.size() && key(before[o]) < key(pairs[i]); ++o) orphans.push_back(&before[o]);
    if (o < before.size() && key(before[o]) == key(pairs[i])) {
      pairs[i].at.force = before[o].force + share * before[o].change;
      pairs[i].penalty_scale = before[o].penalty_scale;
      const int mode = before[o].mode;
      const double last = before[o].missed, now = violation(pairs[i].at, mode);
      if (exact && share == 1.0 && mode != contact_open && last > settings.length_tolerance &&
          last < settings.stall_up_to * pairs[i].scale && now > settings.stall_ratio * last) {
        pairs[i].penalty_scale = std::min(settings.penalty_growth * before[o].penalty_scale, settings.penalty_max);
      }
      pairs[i].at.along *= pairs[i].penalty_scale;
      pairs[i].at.across *= pairs[i].penalty_scale;
      ++o;
    } else {
      fresh.push_back(i);
    }
  }
  for (; o < before.size(); ++o) orphans.push_back(&before[o]);
  for (const PairPast* orphan : orphans) {
    const Vector3d force = orphan->force + share * orphan->change;
    if (force.isZero(0.0)) continue;
    std::size_t match = pairs.size();
    double best = settings.match_cosine;
    for (std::size_t i : fresh) {
      const Candidate &a = pairs[i].who, &b = orphan->who;
      if (a.kind != b.kind) continue;
      const bool common = a.kind == PairKind::vertex_triangle ? a.first == b.first
                                                              : a.first == b.first || a.second == b.second ||
                                                                    a.first == b.second || a.second == b.first;
      if (!common) continue;
      const double alike = pairs[i].at.normal.dot(orphan->normal);
      if (alike > best) best = alike, match = i;
    }
    if (match < pairs.size()) {
      pairs[match].at.force += force;
      continue;
    }
    best = settings.transfer_radius * orphan->scale;
    for (std::size_t i = 0; i < pairs.size(); ++i) {
      const double far = (pairs[i].middle - orphan->middle).norm();
      const double alike = pairs[i].at.normal.dot(orphan->normal);
      if (far < best && std::abs(alike) > settings.match_cosine) best = far, match = i;
    }
    if (match < pairs.size()) {
      pairs[match].at.force += pairs[match].at.normal.dot(orphan->normal) > 0.0 ? force : Vector3d(-force);
    }
  }
}

void merge(std::vector<Pair>& pairs, const Surface& surface, const ContactMaterials& materials,
           const ContactSettings& settings) {
  const std::size_t count = pairs.size();
  const Vector3d across(0.62, 0.55, 0.56);  // along no edge of a mesh that is aligned with the axes
  std::vector<std::pair<double, std::size_t>> line(count);
  for (std::size_t i = 0; i < count; ++i) line[i] = {across.dot(pairs[i].middle), i};
  std::sort(line.begin(), line.end());
  std::vector<std::size_t> place(count), order(count);
  for (std::size_t l = 0; l < count; ++l) place[line[l].second] = l;
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::vector<std::tuple<bool, bool, double>> rank(count);  // whether it keeps less apart, has no force; its gap
  for (std::size_t i = 0; i < count; ++i) {
    const auto sheet = [&](int c) { return surface.sheet_of_node[pairs[i].who.node[c]]; };
    rank[i] = {pairs[i].thickness < materials.apart(sheet(0), sheet(3)), pairs[i].at.force.isZero(0.0),
               pairs[i].at.gap};
  }
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return rank[a] < rank[b]; });
  std::vector<char> gone(count, 0);
  for (std::size_t i : order) {
    if (gone[i]) continue;
    const double radius = settings.merge_radius * pairs[i].scale;
    const auto body = [&](std::size_t j) {
      const auto& node = pairs[j].who.node;
      return materials.bone_of(surface.sheet_of_node[node[0]], surface.sheet_of_node[node[3]]);
    };
    const auto take = [&](std::size_t j) {
      if (gone[j] || body(j) != body(i) || (pairs[j].middle - pairs[i].middle).squaredNorm() > radius * radius) return;
      const Vector3d& force = pairs[j].at.force;
      pairs[i].at.force += pairs[i].at.normal.dot(pairs[j].at.normal) > 0.0 ? force : Vector3d(-force);
      gone[j] = 1;
    };
    const double reach = 1.01 * radius;
    for (std::size_t l = place[i]; l-- > 0 && line[place[i]].first - line[l].first < reach;) take(line[l].second);
    for (std::size_t l = place[i] + 1; l < count && line[l].first - line[place[i]].first < reach; ++l)
      take(line[l].second);
  }
  std::size_t kept = 0;
  for (std::size_t i = 0; i < count; ++i) {
    if (gone[i]) continue;
    if (kept != i) pairs[kept] = pairs[i];
    ++kept;
  }
  pairs.erase(pairs.begin() + static_cast<std::ptrdiff_t>(kept), pairs.end());
}

}  // namespace sim_core
