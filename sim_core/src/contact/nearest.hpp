// The triangle that is nearest to a point, by a tree of boxes.
#pragma once

#include <Eigen/Geometry>
#include <array>
#include <functional>
#include <vector>

#include "math/buffer.hpp"

namespace sim_core {

struct Nearest {
  int triangle = -1;        // none is within reach
  Eigen::Vector3d weights;  // barycentric, of its closest point
};

class TriangleTree {
 public:
  TriangleTree(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x);

  // Takes the triangles to where they are at x.
  void fit(const Buffer<double>& x);
  // Of the triangles that `counts`, within `reach`; of equally near ones that with the lower number.
  Nearest nearest(const Eigen::Vector3d& p, double reach, const std::function<bool(int triangle)>& counts) const;

 private:
  struct Box {
    Eigen::AlignedBox3d around;
    int begin, end;  // of order_
    int right;       // the second child; the first follows its parent. 0: a leaf
  };
  int build(int begin, int end, const std::vector<Eigen::Vector3d>& middles);

  std::vector<std::array<int, 3>> triangles_;
  std::vector<int> order_;
  std::vector<Box> boxes_;
  std::vector<std::array<Eigen::Vector3d, 3>> corners_;  // by triangle
};

}  // namespace sim_core
