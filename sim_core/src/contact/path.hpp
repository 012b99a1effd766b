// Pairs of pieces that are near each other, and how far nodes may move so that nothing crosses.
#pragma once

#include <array>
#include <vector>

#include "contact/closest.hpp"
#include "contact/surface.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// A vertex and a triangle, or two edges, that are near each other.
struct Candidate {
  PairKind kind;
  int first, second;        // a vertex (node) and a triangle, or two edges, the lower first
  std::array<int, 4> node;  // in the order of closest_weights
  double distance;          // at the search, m; later a lower bound of it

  // Whether a node of the four belongs to the first piece.
  bool on_first(int c) const { return c < (kind == PairKind::vertex_triangle ? 1 : 2); }
};

FourPoints points_of(const Candidate& pair, const Buffer<double>& x);
// How much the distance of two pieces can change at most, if nodes move by `displacements`, m.
double fastest(const Candidate& pair, const std::vector<double>& displacements);

// All pairs of sheets that touch each other, without a common node, that are within `reach` at x:
// vertices and triangles first, sorted by (first, second). By a grid of cells about as large as a
// triangle.
std::vector<Candidate> candidates(const Surface& surface, const Buffer<double>& x, double reach);

// The pairs that are near: all that can come within `thickness`, the largest, while no node has
// moved further than `skin` since the search, but for a displacement that all have in common.
class CandidateSet {
 public:
  CandidateSet(Surface surface, double thickness, double skin);

  const Surface surface;
  const double thickness;

  // The pairs, for positions x. The `distance` of each is at most that at x.
  std::vector<Candidate>& pairs(const Buffer<double>& x);

  // Moves `to` back towards `from` where a pair would come nearer than half its distance or half
  // the thickness, so that nothing crosses on the straight paths between [Li et al. 2021, additive
  // CCD]: each node by as much as its pairs demand. Returns whether nothing was moved. A long path
  // is taken in hops of at most two skins, with a search on each, and ends after `hops_max` of
  // them.
  bool limit_by_ccd(const Buffer<double>& from, Buffer<double>& to, int hops_max = 64);

  // The fraction of the straight path from `from` to `to` that all nodes can go together, so that
  // every pair that is near at `from` keeps half its distance or half the thickness.
  double collision_free_fraction(const Buffer<double>& from, const Buffer<double>& to);

  double skin() const { return skin_; }

  // Writes the length of each vertex's displacement but for a common one, m, and returns that: the
  // middle of the box of all displacements.
  Eigen::Vector3d measure(const Buffer<double>& from, const Buffer<double>& to,
                          std::vector<double>& displacements) const;

 private:
  // Bound of all displacements from `from` to `to`, to `or_to`, or to any position between both,
  // but for a common one, m.
  double moved(const Buffer<double>& from, const Buffer<double>& to,
               const Buffer<double>* or_to = nullptr) const;
  void rebuild(const Buffer<double>& x);
  MinDistanceRule rule() const;
  // Whether the pairs at hand are all that are near x.
  bool is_listed(const Buffer<double>& x) const;
  // As `limit_by_ccd`, where the pairs at hand are complete on the whole path.
  bool limit_listed(const Buffer<double>& from, Buffer<double>& to);
  bool limit_by_hops(const Buffer<double>& from, Buffer<double>& to, int hops_max);

  // A part of a path, short enough for one search.
  struct Hop {
    double fraction;             // of the path
    Buffer<double> wanted, end;  // where nodes would go, and where they arrive
    bool is_stopped;             // whether these differ
  };
  Hop hop(const Buffer<double>& at, const Buffer<double>& to);
  Hop hop_by(const Buffer<double>& at, const Buffer<double>& to, double fraction);
  // Where a node on its way to `to` is stopped, as far as is known in `limit_listed`.
  Eigen::Vector3d limited(int node, const Buffer<double>& from, const Buffer<double>& to) const;
  double safe_fraction_of(const Candidate& pair, const Buffer<double>& from,
                          const Buffer<double>& to) const;

  double skin_;
  std::vector<Candidate> pairs_;
  Buffer<double> reference_, at_;  // positions of the search, and of the distances of the pairs
  // By node: the fraction of its path that it may go, its displacement since `at_`, and that on its
  // path, m.
  std::vector<double> fraction_, drift_, displacement_;
};

}  // namespace sim_core
