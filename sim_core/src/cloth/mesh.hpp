// A triangle mesh at rest in the plane.
#pragma once

#include <Eigen/Core>
#include <array>
#include <cstdint>
#include <vector>

namespace sim_core {

using Points2 = Eigen::Matrix<double, Eigen::Dynamic, 2, Eigen::RowMajor>;
using Points3 = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;
using Triangles = Eigen::Matrix<std::int32_t, Eigen::Dynamic, 3, Eigen::RowMajor>;

struct ClothMesh {
  struct Edge {
    int a, b;  // a < b
    std::array<int, 2> triangle{-1, -1};
    std::array<int, 2> corner{-1, -1};  // the one opposite, 0 ... 2
    bool boundary() const { return triangle[1] < 0; }
  };

  Points2 rest;
  Triangles triangles;
  std::vector<Edge> edges;
  std::vector<std::array<int, 3>> triangle_edges;  // opposite corner 0, 1, 2
  Eigen::VectorXd area;
  std::vector<int> sheet_of_vertex;  // pieces that hang together, in the order of their first vertices
  int sheets = 0;

  // Throws std::invalid_argument, naming the field, unless this is a triangulation of a surface with positive areas.
  ClothMesh(Points2 rest, Triangles triangles);

 private:
  void find_sheets();
};

}  // namespace sim_core
