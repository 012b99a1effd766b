// Cloth that lands on its edge.
//
// What lands flat stops where it lands. What lands with a speed in its own plane, v, is compressed
// from there: a wave runs into the sheet, and the sheet buckles behind it within milliseconds. The
// force of the impact is that of the wave until then. A long step buckles the sheet at once, and
// has less force, or more.
#pragma once

#include <vector>

#include "cloth/followed_slip.hpp"
#include "cloth/mesh.hpp"

namespace sim_core {

class Landings {
 public:
  Landings(const ClothMesh& mesh, const Numbering& numbering);

  // Largest way within its sheet, m, that a free node which lands in the step would go into what it
  // lands on, if nothing stopped it and it closed in for the whole step.
  double largest_way(const SolvedStep& step) const;

 private:
  bool lands(int node, const SolvedStep& step) const;

  std::vector<int> corners_;  // (triangles, 3): nodes
};

}  // namespace sim_core
