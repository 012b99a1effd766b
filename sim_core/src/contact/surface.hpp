// Triangles that may touch: their corners, edges, and what lies around each.
#pragma once

#include <Eigen/Core>
#include <array>
#include <vector>

namespace sim_core {

using CollisionMask = Eigen::Matrix<bool, Eigen::Dynamic, Eigen::Dynamic>;

// Points, segments and triangles of skeletons, by node. Their nodes are the last.
struct Bones {
  std::vector<int> points;
  std::vector<std::array<int, 2>> segments;
  std::vector<std::array<int, 3>> triangles;
};

struct Surface {
  std::vector<std::array<int, 3>> triangles;       // nodes
  std::vector<std::array<int, 2>> edges;           // nodes, the lower first; ascending
  std::vector<std::array<int, 3>> triangle_edges;  // opposite corner 0, 1, 2
  std::vector<int> vertices;                       // nodes that are corners, ascending
  std::vector<int> triangles_of_edge;              // counts
  std::vector<int> around_begin, around;           // triangles around each node, ascending
  std::vector<int> sheet_of_node;
  int bone_triangles, bone_edges, bone_vertices;  // where those of skeletons begin
  CollisionMask collides;                         // whether two sheets touch each other
  std::vector<int> last_collider;                 // by sheet: the last node that it touches

  Surface(std::vector<std::array<int, 3>> triangles, std::vector<int> sheet_of_node, CollisionMask collides,
          const Bones& bones = {});
  bool may_touch(int node, int other) const { return collides(sheet_of_node[node], sheet_of_node[other]); }
};

}  // namespace sim_core
