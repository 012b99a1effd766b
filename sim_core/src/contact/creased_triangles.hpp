// Triangles of a smooth surface: their orientation, neighbours, and which edges are sharp.
#pragma once

#include <Eigen/Core>
#include <array>
#include <map>
#include <vector>

#include "math/buffer.hpp"

namespace sim_core {

struct CreasedTriangles {
  std::vector<std::array<int, 3>> triangles;  // nodes, oriented alike where they can be
  std::vector<std::array<int, 3>> across;     // triangle over the edge opposite each corner; -1 at a border
  std::vector<std::array<int, 3>> sharp;      // 1 where that edge is sharp
  std::vector<std::array<int, 3>> group;      // of the corners; corners of one group share a normal
  std::vector<int> around_begin, around;      // triangles around each node
  int groups = 0;

  // `crease`: angle between the normals of two triangles from which their edge is sharp, rad, of each triangle.
  CreasedTriangles(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x,
                   const std::vector<double>& crease);

  Eigen::Vector3d facet_normal(const Buffer<double>& x, int triangle) const;
  // Corner of a triangle at a node.
  int corner_of(int triangle, int node) const;

 private:
  using Sides = std::map<std::array<int, 2>, std::vector<int>>;  // triangles at each edge
  int other(const Sides& sides, int triangle, int corner) const;
  bool runs(int triangle, int i, int j) const;
  void orient(const Sides& sides);
  void find_sharp(const Sides& sides, const Buffer<double>& x, const std::vector<double>& crease);
};

}  // namespace sim_core
