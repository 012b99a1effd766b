// Numbers of nodes: free vertices in the order of elimination, then held vertices, then the vertices of
// surfaces and the points of skeletons, which are no cloth and move as prescribed.
#pragma once

#include <cstdint>
#include <vector>

#include "cloth/ordering.hpp"
#include "cloth/plate.hpp"

namespace sim_core {

struct Numbering {
  int vertices, others, bones, nodes, free_nodes;
  std::vector<int> node, vertex;  // of a vertex, another or a point of a skeleton, and back
  std::vector<int> held;          // nodes of the held vertices, in the caller's order
  Dissection dissection;
  Pattern bending, compact_bending, membrane;  // of the free nodes

  // Throws std::invalid_argument, naming `held`.
  Numbering(const ClothMesh& mesh, const std::vector<Stencil>& stencils, const std::vector<Stencil>& compact,
            const std::vector<std::int32_t>& held, int others, int bones);
};

}  // namespace sim_core
