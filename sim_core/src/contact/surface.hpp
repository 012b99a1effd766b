// Triangles that may touch: their corners, edges, and what lies around each.
#pragma once

#include <array>
#include <vector>

namespace sim_core {

struct Surface {
  std::vector<std::array<int, 3>> triangles;              // nodes
  std::vector<std::array<int, 2>> edges;                  // nodes, the lower first; ascending
  std::vector<std::array<int, 3>> triangle_edges;         // opposite corner 0, 1, 2
  std::vector<int> vertices;                              // nodes that are corners, ascending
  std::vector<int> triangles_of_edge, triangles_of_node;  // counts
  std::vector<int> sheet_of_node;

  Surface(std::vector<std::array<int, 3>> triangles, std::vector<int> sheet_of_node);
};

}  // namespace sim_core
