// Closest points of a point and a triangle, and of two segments, as weights of their four nodes.
//
// The vector between them is rho = sum w_i x_i: from the triangle to the point with w = (1, -b), b
// barycentric, and from the second segment to the first with w = (1 - s, s, -(1 - t), -t). At an
// optimum its length changes by n . sum w_i dx_i, n = rho/|rho|, whatever the weights do: they are
// stationary.
#pragma once

#include <Eigen/Geometry>
#include <array>
#include <functional>
#include <vector>

#include "math/buffer.hpp"

namespace sim_core {

using FourPoints = std::array<Eigen::Vector3d, 4>;

// Which four points: a point and the three of a triangle, or the two and two of segments.
enum class PairKind : int { vertex_triangle = 0, edge_edge = 1 };

// Barycentric coordinates of the point of the triangle abc that is closest to p; those that are
// zero are exactly so [Ericson 2005, 5.1.5].
Eigen::Vector3d closest_on_triangle(const Eigen::Vector3d& p, const Eigen::Vector3d& a,
                                    const Eigen::Vector3d& b, const Eigen::Vector3d& c);

// The same for the four points of a pair [Ericson 2005, 5.1.5 and 5.1.9]. Segments that are
// parallel have one of their closest points.
Eigen::Vector4d closest_weights(PairKind kind, const FourPoints& x);

// rho.
inline Eigen::Vector3d between_closest(const Eigen::Vector4d& weights, const FourPoints& x) {
  return weights[0] * x[0] + weights[1] * x[1] + weights[2] * x[2] + weights[3] * x[3];
}

// Squared sine of the angle of the two segments.
double crossing_squared(const FourPoints& x);

// What a motion may leave of a distance, m: a share of it, or of `most` where that is less. Below
// `floor` it takes nothing, else many motions would take a distance to rounding, and past it.
struct MinDistanceRule {
  double share;
  double most;
  double floor = 0.0;

  double of(double distance) const;
};

// A share of the straight motion from x to `to` up to which the distance stays above the required
// share of that at x; 1 if it does to the end. Never too large, and too small by little [Li et al.
// 2021, additive CCD, Algorithm 1].
double safe_share(PairKind kind, const FourPoints& x, const FourPoints& to,
                  const MinDistanceRule& rule_of);

// The triangle that is nearest to a point.
struct Nearest {
  int triangle = -1;        // none is within reach
  Eigen::Vector3d weights;  // barycentric, of its closest point
};

// Finds it by a tree of boxes.
class TriangleTree {
 public:
  TriangleTree(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x);

  // Takes the triangles to where they are at x.
  void fit(const Buffer<double>& x);
  // Of the triangles that `counts`, within `reach`; of equally near ones that with the lower
  // number.
  Nearest nearest(const Eigen::Vector3d& p, double reach,
                  const std::function<bool(int triangle)>& counts) const;

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
