// Pairs of a vertex and a triangle, and of two edges, that are near each other.
#pragma once

#include <array>
#include <vector>

#include "contact/closest.hpp"
#include "contact/surface.hpp"
#include "math/buffer.hpp"

namespace sim_core {

struct Candidate {
  PairKind kind;
  int first, second;        // a vertex (node) and a triangle, or two edges, the lower first
  std::array<int, 4> node;  // in the order of closest_weights
  double distance;          // where they were looked for, m

  // Whether a node of the four belongs to the first.
  bool on_first(int c) const { return c < (kind == PairKind::vertex_triangle ? 1 : 2); }
};

FourPoints points_of(const Candidate& pair, const Buffer<double>& x);

// All pairs of sheets that touch each other, without a common node, that are within `reach` at x: vertices and
// triangles first, sorted by (first, second). By a grid of cells about as large as a triangle. `farther`: of each
// sheet, how much larger the reach is of pairs with it, m; other than 0 of skeletons only.
std::vector<Candidate> candidates(const Surface& surface, const Buffer<double>& x, double reach,
                                  const std::vector<double>& farther = {});

}  // namespace sim_core
