#include "contact/path.hpp"

#include <algorithm>
#include <limits>
#include <utility>

namespace sim_core {
namespace {

using Eigen::Array3d;

// Of the distance of a pair, what a motion leaves.
constexpr double keep = 0.2;
// Rounds in which nodes are capped one by one; after them all are by the same share.
constexpr int rounds_max = 8;
// Ways longer than so many margins end there.
constexpr int hops_max = 64;

}  // namespace

Neighbourhood::Neighbourhood(Surface surface_in, double thickness_in, double margin)
    : surface(std::move(surface_in)),
      thickness(thickness_in),
      margin_(margin),
      share_(surface.sheet_of_node.size(), 1.0) {}

// Half of the largest side of the box of the motions, which bounds them but for a common one.
double Neighbourhood::moved(const Buffer<double>& from, const Buffer<double>& to) const {
  Array3d low = Array3d::Constant(std::numeric_limits<double>::infinity()), high = -low;
  for (int i : surface.vertices) {
    const Array3d way = (at_node(to, i) - at_node(from, i)).array();
    low = low.min(way);
    high = high.max(way);
  }
  return 0.5 * (high - low).matrix().norm();
}

void Neighbourhood::rebuild(const Buffer<double>& x) {
  reference_ = x;
  pairs_ = candidates(surface, x, thickness + 2.0 * margin_);
  ++rebuilds;
}

const std::vector<Candidate>& Neighbourhood::pairs(const Buffer<double>& x) {
  if (reference_.empty() || !(moved(reference_, x) <= margin_)) rebuild(x);
  return pairs_;
}

bool Neighbourhood::cap(const Buffer<double>& from, Buffer<double>& to) {
  if (!reference_.empty() && moved(reference_, from) <= margin_ && moved(reference_, to) <= margin_) {
    return cap_near(from, to);
  }
  Buffer<double> at = from;
  bool whole = true;
  for (int hop = 0; hop < hops_max; ++hop) {
    // From the middle of a hop both of its ends are within the margin.
    const double way = moved(at, to), share = way > 2.0 * margin_ ? 2.0 * margin_ / way : 1.0;
    const auto part = [&](double of_way) {
      Buffer<double> out = at;
      for (int i : surface.vertices) at_node(out, i) += of_way * (at_node(to, i) - at_node(at, i));
      return out;
    };
    rebuild(part(0.5 * share));
    if (share == 1.0) return cap_near(at, to) && whole;
    Buffer<double> next = part(share);
    const Buffer<double> wanted = next;
    if (!cap_near(at, next)) {
      // Who is stopped has arrived.
      whole = false;
      for (int i : surface.vertices) {
        if (at_node(next, i) != at_node(wanted, i)) at_node(to, i) = at_node(next, i);
      }
    }
    at = std::move(next);
  }
  for (int i : surface.vertices) at_node(to, i) = at_node(at, i);
  return false;
}

double Neighbourhood::common_share(const Buffer<double>& from, const Buffer<double>& to) {
  double least = 1.0;
  for (const Candidate& pair : pairs(from)) {
    least = std::min(least, safe_share(pair.kind, points_of(pair, from), points_of(pair, to), keep));
  }
  return least;
}

bool Neighbourhood::cap_near(const Buffer<double>& from, Buffer<double>& to) {
  std::fill(share_.begin(), share_.end(), 1.0);
  bool whole = true;
  const auto place = [&](int i) -> Eigen::Vector3d {
    if (share_[i] == 1.0) return at_node(to, i);
    return at_node(from, i) + share_[i] * (at_node(to, i) - at_node(from, i));
  };
  double least = 1.0;
  for (int round = 0; round <= rounds_max; ++round) {
    least = 1.0;
    for (const Candidate& pair : pairs_) {
      const FourPoints ends{place(pair.node[0]), place(pair.node[1]), place(pair.node[2]), place(pair.node[3])};
      const double safe = safe_share(pair.kind, points_of(pair, from), ends, keep);
      if (safe == 1.0) continue;
      least = std::min(least, safe);
      if (round == rounds_max) continue;
      for (int i : pair.node) share_[i] *= safe;
    }
    if (least == 1.0) break;
    whole = false;
    if (round == rounds_max) {
      for (int i : surface.vertices) share_[i] *= least;
    }
  }
  for (int i : surface.vertices) {
    if (share_[i] != 1.0) at_node(to, i) = place(i).eval();
  }
  return whole;
}

}  // namespace sim_core
