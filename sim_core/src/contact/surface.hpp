// Triangles that may touch: their corners, edges, and what lies around each.
#pragma once

#include <Eigen/Core>
#include <array>
#include <vector>

namespace sim_core {

using Felt = Eigen::Matrix<bool, Eigen::Dynamic, Eigen::Dynamic>;

struct Surface {
  std::vector<std::array<int, 3>> triangles;       // nodes
  std::vector<std::array<int, 2>> edges;           // nodes, the lower first; ascending
  std::vector<std::array<int, 3>> triangle_edges;  // opposite corner 0, 1, 2
  std::vector<int> vertices;                       // nodes that are corners, ascending
  std::vector<int> triangles_of_edge;              // counts
  std::vector<int> around_begin, around;           // triangles around each node, ascending
  std::vector<int> sheet_of_node;
  Felt felt;                   // whether each two sheets feel each other
  std::vector<int> last_felt;  // by sheet: the last node of those that it feels

  Surface(std::vector<std::array<int, 3>> triangles, std::vector<int> sheet_of_node, Felt felt);
  bool feel(int node, int other) const { return felt(sheet_of_node[node], sheet_of_node[other]); }
};

}  // namespace sim_core
