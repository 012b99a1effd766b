#include "contact/path.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <utility>

#include "contact/constants.hpp"

namespace sim_core {
namespace {

using Eigen::AlignedBox3d;

// Rounds in which nodes are stopped one by one; after them all are stopped by the same share.
constexpr int rounds_max = 8;

AlignedBox3d box_of_ways(const Surface& surface, const Buffer<double>& from,
                         const Buffer<double>& to) {
  AlignedBox3d out;
  for (int i : surface.vertices) out.extend(at_node(to, i) - at_node(from, i));
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
  AlignedBox3d box = box_of_ways(surface, from, to);
  if (or_to) box.extend(box_of_ways(surface, from, *or_to));
  return 0.5 * box.diagonal().norm();
}

Eigen::Vector3d CandidateSet::measure(const Buffer<double>& from, const Buffer<double>& to,
                                      std::vector<double>& displacements) const {
  const AlignedBox3d box = box_of_ways(surface, from, to);
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
  if (reference_.empty() || !(moved(reference_, x) <= skin_)) rebuild(x);
  measure(at_, x, displacement_);
  for (Candidate& pair : pairs_) pair.distance -= fastest(pair, displacement_);
  at_ = x;
  return pairs_;
}

bool CandidateSet::limit_by_ccd(const Buffer<double>& from, Buffer<double>& to, int hops_max) {
  if (!reference_.empty() && moved(reference_, from) <= skin_ && moved(reference_, to) <= skin_) {
    Buffer<double> capped = to;
    if (limit_listed(from, capped)) return true;
    if (moved(reference_, from, &to) <= skin_) {
      to = std::move(capped);
      return false;
    }
  }
  Buffer<double> at = from;
  bool whole = true;
  for (int hop = 0; hop < hops_max; ++hop) {
    const auto part = [&](double fraction) {
      Buffer<double> out = at;
      for (int i : surface.vertices)
        at_node(out, i) += fraction * (at_node(to, i) - at_node(at, i));
      return out;
    };
    // From the middle of a hop both of its ends are within the skin, but for a common
    // displacement. Nodes that are stopped do not go that: so where there are any, the hop is
    // shorter.
    double fraction = std::min(1.0, 2.0 * skin_ / moved(at, to));
    rebuild(part(0.5 * fraction));
    Buffer<double> wanted = part(fraction), next = wanted;
    bool stopped = !limit_listed(at, next);
    const double shorter = skin_ / moved(part(0.5), at, &to);
    if (stopped && shorter < fraction) {
      fraction = shorter;
      rebuild(part(0.5 * fraction));
      wanted = next = part(fraction);
      stopped = !limit_listed(at, next);
    }
    if (stopped) {  // who is has arrived
      whole = false;
      for (int i : surface.vertices) {
        if (at_node(next, i) != at_node(wanted, i)) at_node(to, i) = at_node(next, i);
      }
    }
    at = std::move(next);
    if (fraction == 1.0) return whole;
  }
  for (int i : surface.vertices) at_node(to, i) = at_node(at, i);
  return false;
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

// The share of its way from `from` to where its nodes are let that a pair may go.
double CandidateSet::safe_fraction_of(const Candidate& pair, const Buffer<double>& from,
                                      const Buffer<double>& to) const {
  const double distance = pair.distance - fastest(pair, drift_);
  if (fastest(pair, displacement_) <= distance - rule().of(distance)) return 1.0;
  FourPoints ends;
  for (int c = 0; c < 4; ++c) ends[c] = limited(pair.node[c], from, to);
  return safe_fraction(pair.kind, points_of(pair, from), ends, rule());
}

bool CandidateSet::limit_listed(const Buffer<double>& from, Buffer<double>& to) {
  measure(at_, from, drift_);
  const Eigen::Vector3d common = measure(from, to, displacement_);
  std::fill(fraction_.begin(), fraction_.end(), 1.0);
  const auto shorten = [&](int i, double fraction) {
    fraction_[i] *= fraction;
    displacement_[i] = (limited(i, from, to) - at_node(from, i) - common).norm();
  };
  bool whole = true;
  for (int round = 0; round <= rounds_max; ++round) {
    double least = 1.0;
    for (const Candidate& pair : pairs_) {
      const double safe = safe_fraction_of(pair, from, to);
      if (safe == 1.0) continue;
      least = std::min(least, safe);
      if (round == rounds_max) continue;
      for (int i : pair.node) shorten(i, safe);
    }
    if (least == 1.0) break;
    whole = false;
    if (round == rounds_max) {
      for (int i : surface.vertices) fraction_[i] *= least;
    }
  }
  for (int i : surface.vertices) {
    if (fraction_[i] != 1.0) at_node(to, i) = limited(i, from, to);
  }
  return whole;
}

}  // namespace sim_core
