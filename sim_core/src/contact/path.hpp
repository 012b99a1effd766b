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
  double distance;          // where they were looked for, m

  // Whether a node of the four belongs to the first.
  bool on_first(int c) const { return c < (kind == PairKind::vertex_triangle ? 1 : 2); }
};

FourPoints points_of(const Candidate& pair, const Buffer<double>& x);
// No distance of a point of the first from one of the second changes by more, if nodes go
// `displacements`, m.
double fastest(const Candidate& pair, const std::vector<double>& displacements);

// All pairs of sheets that touch each other, without a common node, that are within `reach` at x:
// vertices and triangles first, sorted by (first, second). By a grid of cells about as large as a
// triangle.
std::vector<Candidate> candidates(const Surface& surface, const Buffer<double>& x, double reach);

// Knows which pairs are near: all that can come within `thickness`, the largest, while no node has
// moved further than `skin` from where it was, whatever common displacement all have come.
class CandidateSet {
 public:
  CandidateSet(Surface surface, double thickness, double skin);

  const Surface surface;
  const double thickness;

  // The pairs, for positions x. Of each, `distance` is at most its distance there.
  std::vector<Candidate>& pairs(const Buffer<double>& x);

  // Moves `to` back towards `from` where a pair would come nearer than half its distance or half
  // the thickness, so that nothing crosses on the straight paths between: each node by as
  // much as its pairs demand. Returns whether nothing was moved. Ways of more than `hops_max` times
  // two skins end there: pairs are looked for anew on each hop.
  bool limit_by_ccd(const Buffer<double>& from, Buffer<double>& to, int hops_max = 64);

  // The share of the straight path from `from` to `to` that all nodes can go together, so
  // that every pair that is near at `from` keeps half its distance or half the thickness.
  double collision_free_fraction(const Buffer<double>& from, const Buffer<double>& to);

  double skin() const { return skin_; }

  // Of each vertex the length of its displacement but for a common one, which it returns: the
  // middle of the box of all displacements.
  Eigen::Vector3d measure(const Buffer<double>& from, const Buffer<double>& to,
                          std::vector<double>& displacements) const;

 private:
  // What bounds all displacements from there to one of two places, or between them, but for a
  // common one, m.
  double moved(const Buffer<double>& from, const Buffer<double>& to,
               const Buffer<double>* or_to = nullptr) const;
  void rebuild(const Buffer<double>& x);
  MinDistanceRule rule() const;
  bool limit_listed(const Buffer<double>& from, Buffer<double>& to);
  // Where a node on its way to `to` is stopped, as far as is known in `limit_listed`.
  Eigen::Vector3d limited(int node, const Buffer<double>& from, const Buffer<double>& to) const;
  double safe_fraction_of(const Candidate& pair, const Buffer<double>& from,
                          const Buffer<double>& to) const;

  double skin_;
  std::vector<Candidate> pairs_;
  Buffer<double> reference_, at_;  // where they were looked for, and where their distances are from
  std::vector<double> fraction_, drift_, displacement_;
};

}  // namespace sim_core
