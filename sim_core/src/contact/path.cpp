// How far cloth may go in a step or an iteration so that nothing crosses.
//
// Candidates are the pairs that were near at the positions `reference_`. They stay complete while
// no node moves by more than the skin, but for a displacement that all have in common: cloth that
// falls needs no new search. Each candidate carries a lower bound of its distance, which shrinks by
// what its nodes move. Only those whose bound is used up are measured again.
#include "contact/path.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <utility>

#include "contact/constants.hpp"

namespace sim_core {
namespace {

using Eigen::AlignedBox3d;

// Rounds in which nodes are stopped one by one; after them all are stopped by the same fraction.
constexpr int rounds_max = 8;

AlignedBox3d box_of_displacements(const Surface& surface, const Buffer<double>& from,
                                  const Buffer<double>& to) {
  AlignedBox3d out;
  for (int i : surface.vertices) out.extend(at_node(to, i) - at_node(from, i));
  return out;
}

// The positions at a fraction of the straight paths.
Buffer<double> between(const Surface& surface, const Buffer<double>& from, const Buffer<double>& to,
                       double fraction) {
  Buffer<double> out = from;
  for (int i : surface.vertices) at_node(out, i) += fraction * (at_node(to, i) - at_node(from, i));
  return out;
}

}  // namespace

double fastest(const Candidate& pair, const std::vector<double>& displacements) {
  const auto& node = pair.node;
  if (pair.kind == PairKind::vertex_triangle) {
    return displacements[node[0]] +
           std::max({displacements[node[1]], displacements[node[2]], displacements[node[3]]});
  }
  return std::max(displacements[node[0]], displacements[node[1]]) +
         std::max(displacements[node[2]], displacements[node[3]]);
}

CandidateSet::CandidateSet(Surface surface_in, double thickness_in, double skin)
    : surface(std::move(surface_in)),
      thickness(thickness_in),
      skin_(skin),
      fraction_(surface.sheet_of_node.size(), 1.0),
      drift_(fraction_),
      displacement_(fraction_) {}

MinDistanceRule CandidateSet::rule() const {
  return {path::distance_fraction, thickness, path::distance_min * thickness};
}

// Half of the diagonal of the box of the motions.
double CandidateSet::moved(const Buffer<double>& from, const Buffer<double>& to,
                           const Buffer<double>* or_to) const {
  AlignedBox3d box = box_of_displacements(surface, from, to);
  if (or_to) box.extend(box_of_displacements(surface, from, *or_to));
  return 0.5 * box.diagonal().norm();
}

Eigen::Vector3d CandidateSet::measure(const Buffer<double>& from, const Buffer<double>& to,
                                      std::vector<double>& displacements) const {
  const AlignedBox3d box = box_of_displacements(surface, from, to);
  const Eigen::Vector3d common = 0.5 * (box.min() + box.max());
  for (int i : surface.vertices)
    displacements[i] = (at_node(to, i) - at_node(from, i) - common).norm();
  return common;
}

void CandidateSet::rebuild(const Buffer<double>& x) {
  reference_ = at_ = x;
  pairs_ = candidates(surface, x, thickness + 2.0 * skin_);
}

std::vector<Candidate>& CandidateSet::pairs(const Buffer<double>& x) {
  if (!is_listed(x)) rebuild(x);
  measure(at_, x, displacement_);
  for (Candidate& pair : pairs_) pair.distance -= fastest(pair, displacement_);
  at_ = x;
  return pairs_;
}

bool CandidateSet::is_listed(const Buffer<double>& x) const {
  return !reference_.empty() && moved(reference_, x) <= skin_;
}

bool CandidateSet::limit_by_ccd(const Buffer<double>& from, Buffer<double>& to, int hops_max) {
  // Most motions are short, and the listed pairs suffice for them.
  if (is_listed(from) && is_listed(to)) {
    Buffer<double> capped = to;
    if (limit_listed(from, capped)) return true;
    // Nodes that are stopped stay behind the displacement that all have in common. Wherever they
    // stop, they must be within the skin.
    if (moved(reference_, from, &to) <= skin_) {
      to = std::move(capped);
      return false;
    }
  }
  return limit_by_hops(from, to, hops_max);
}

// Each hop begins with a new search, and goes as far as its pairs are complete.
bool CandidateSet::limit_by_hops(const Buffer<double>& from, Buffer<double>& to, int hops_max) {
  Buffer<double> at = from;
  bool is_free = true;
  for (int count = 0; count < hops_max; ++count) {
    Hop next = hop(at, to);
    if (next.is_stopped) {
      is_free = false;
      // A node that is stopped has arrived: the next hops leave it there.
      for (int i : surface.vertices) {
        if (at_node(next.end, i) != at_node(next.wanted, i)) at_node(to, i) = at_node(next.end, i);
      }
    }
    at = std::move(next.end);
    if (next.fraction == 1.0) return is_free;
  }
  for (int i : surface.vertices) at_node(to, i) = at_node(at, i);
  return false;
}

// From the middle of a hop both of its ends are within the skin, but for a common displacement.
// Nodes that are stopped do not go that: so where there are any, the hop is shorter.
CandidateSet::Hop CandidateSet::hop(const Buffer<double>& at, const Buffer<double>& to) {
  Hop longest = hop_by(at, to, std::min(1.0, 2.0 * skin_ / moved(at, to)));
  if (!longest.is_stopped) return longest;
  const double shorter = skin_ / moved(between(surface, at, to, 0.5), at, &to);
  return shorter < longest.fraction ? hop_by(at, to, shorter) : longest;
}

CandidateSet::Hop CandidateSet::hop_by(const Buffer<double>& at, const Buffer<double>& to,
                                       double fraction) {
  rebuild(between(surface, at, to, 0.5 * fraction));
  Hop hop;
  hop.fraction = fraction;
  hop.wanted = hop.end = between(surface, at, to, fraction);
  hop.is_stopped = !limit_listed(at, hop.end);
  return hop;
}

double CandidateSet::collision_free_fraction(const Buffer<double>& from, const Buffer<double>& to) {
  double least = 1.0;
  const std::vector<Candidate>& near = pairs(from);
  measure(from, to, displacement_);
  for (const Candidate& pair : near) {
    if (fastest(pair, displacement_) <= pair.distance - rule().of(pair.distance)) continue;
    least = std::min(least,
                     safe_fraction(pair.kind, points_of(pair, from), points_of(pair, to), rule()));
  }
  return least;
}

Eigen::Vector3d CandidateSet::limited(int node, const Buffer<double>& from,
                                      const Buffer<double>& to) const {
  if (fraction_[node] == 1.0) return at_node(to, node);
  return at_node(from, node) + fraction_[node] * (at_node(to, node) - at_node(from, node));
}

// The fraction of its path from `from` to where its nodes are let that a pair may go.
double CandidateSet::safe_fraction_of(const Candidate& pair, const Buffer<double>& from,
                                      const Buffer<double>& to) const {
  const double distance = pair.distance - fastest(pair, drift_);
  // The bound tells that its nodes cannot approach by so much.
  if (fastest(pair, displacement_) <= distance - rule().of(distance)) return 1.0;
  FourPoints ends;
  for (int c = 0; c < 4; ++c) ends[c] = limited(pair.node[c], from, to);
  return safe_fraction(pair.kind, points_of(pair, from), ends, rule());
}

// Stops nodes by the listed pairs. A node that is stopped for one pair may come in the way of
// another, so all pairs are asked again, in rounds, until none demands more.
bool CandidateSet::limit_listed(const Buffer<double>& from, Buffer<double>& to) {
  measure(at_, from, drift_);
  const Eigen::Vector3d common = measure(from, to, displacement_);
  std::fill(fraction_.begin(), fraction_.end(), 1.0);
  const auto shorten = [&](int i, double fraction) {
    fraction_[i] *= fraction;
    displacement_[i] = (limited(i, from, to) - at_node(from, i) - common).norm();
  };
  bool is_free = true;
  for (int round = 0; round <= rounds_max; ++round) {
    const bool is_last = round == rounds_max;
    double least = 1.0;
    for (const Candidate& pair : pairs_) {
      const double safe = safe_fraction_of(pair, from, to);
      if (safe == 1.0) continue;
      least = std::min(least, safe);
      if (is_last) continue;
      for (int i : pair.node) shorten(i, safe);
    }
    if (least == 1.0) break;
    is_free = false;
    if (is_last) {
      for (int i : surface.vertices) fraction_[i] *= least;
    }
  }
  for (int i : surface.vertices) {
    if (fraction_[i] != 1.0) at_node(to, i) = limited(i, from, to);
  }
  return is_free;
}

}  // namespace sim_core
