#include "contact/surface.hpp"

#include <algorithm>
#include <utility>

namespace sim_core {

Surface::Surface(std::vector<std::array<int, 3>> triangles_in, std::vector<int> sheet_of_node_in,
                 CollisionMask collides_in)
    : triangles(std::move(triangles_in)),
      around_begin(sheet_of_node_in.size() + 1, 0),
      sheet_of_node(std::move(sheet_of_node_in)),
      collides(std::move(collides_in)),
      last_collider(collides.rows(), -1) {
  for (std::size_t i = 0; i < sheet_of_node.size(); ++i) {
    if (sheet_of_node[i] < 0) continue;
    for (Eigen::Index sheet = 0; sheet < collides.rows(); ++sheet) {
      if (collides(sheet, sheet_of_node[i])) last_collider[sheet] = static_cast<int>(i);
    }
  }
  for (const auto& corners : triangles) {
    for (int c = 0; c < 3; ++c) {
      const int i = corners[(c + 1) % 3], j = corners[(c + 2) % 3];
      edges.push_back({std::min(i, j), std::max(i, j)});
      ++around_begin[corners[c] + 1];
    }
  }
  std::sort(edges.begin(), edges.end());
  edges.erase(std::unique(edges.begin(), edges.end()), edges.end());
  triangles_of_edge.assign(edges.size(), 0);
  for (const auto& corners : triangles) {
    std::array<int, 3> own;
    for (int c = 0; c < 3; ++c) {
      const int i = corners[(c + 1) % 3], j = corners[(c + 2) % 3];
      const std::array<int, 2> edge{std::min(i, j), std::max(i, j)};
      own[c] = static_cast<int>(std::lower_bound(edges.begin(), edges.end(), edge) - edges.begin());
      ++triangles_of_edge[own[c]];
    }
    triangle_edges.push_back(own);
  }
  for (std::size_t i = 0; i < sheet_of_node.size(); ++i) {
    if (around_begin[i + 1] > 0) vertices.push_back(static_cast<int>(i));
    around_begin[i + 1] += around_begin[i];
  }
  around.resize(around_begin.back());
  std::vector<int> next(around_begin.begin(), around_begin.end() - 1);
  for (std::size_t t = 0; t < triangles.size(); ++t) {
    for (int node : triangles[t]) around[next[node]++] = static_cast<int>(t);
  }
}

}  // namespace sim_core
