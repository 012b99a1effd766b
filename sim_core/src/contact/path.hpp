// How far nodes may move so that nothing crosses.
#pragma once

#include <vector>

#include "contact/candidates.hpp"
#include "contact/path_settings.hpp"

namespace sim_core {

// Knows which pairs are near: all that can come within `thickness`, the largest, or `farther` than that by sheet, of
// skeletons, while no node has moved further than `margin` from where it was, whatever common way all have come.
class Neighbourhood {
 public:
  Neighbourhood(Surface surface, double thickness, double margin, const PathSettings& settings = {},
                std::vector<double> farther = {});

  const Surface surface;
  const double thickness;

  // What a pair keeps apart at most, m.
  double apart(const Candidate& pair) const;

  // The pairs, for positions x. Of each, `distance` is at most its distance there.
  std::vector<Candidate>& pairs(const Buffer<double>& x);

  // Moves `to` back towards `from` where a pair would come nearer than half its distance or half the thickness, so that
  // nothing crosses on the straight ways between: each node by as much as its pairs demand. Returns whether nothing was
  // moved. Ways of more than `hops_max` times two margins end there: pairs are looked for anew on each hop.
  bool cap(const Buffer<double>& from, Buffer<double>& to, int hops_max = 64);

  // The share of the straight way from `from` to `to` that all nodes can go together, so that every pair that is near
  // at `from` keeps half its distance or half the thickness.
  double common_share(const Buffer<double>& from, const Buffer<double>& to);

  double margin() const { return margin_; }

  // What bounds all ways from there, but for a common one, m.
  double moved(const Buffer<double>& from, const Buffer<double>& to) const;

 private:
  double moved(const Buffer<double>& from, const Buffer<double>& to, const Buffer<double>& or_to) const;
  void rebuild(const Buffer<double>& x);
  Leaves leaves(const Candidate& pair) const;
  bool cap_near(const Buffer<double>& from, Buffer<double>& to);
  // Of each vertex the length of its way but for a common one, which it returns: the middle of the box of all ways.
  Eigen::Vector3d measure(const Buffer<double>& from, const Buffer<double>& to, std::vector<double>& ways) const;

  double margin_;
  PathSettings settings_;
  std::vector<double> farther_;
  std::vector<Candidate> pairs_;
  Buffer<double> reference_, at_;  // where they were looked for, and where their distances are from
  std::vector<double> share_, drift_, way_;
};

}  // namespace sim_core
