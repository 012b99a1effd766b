// How a surface has turned since the start of a step: a rotation at each node, so that a point that wanders over the
// surface is carried by one that changes without a jump from one triangle to the next.
//
// A triangle turns by Q Q0^T, with Q = [a, n x a, n] of its first side and its normal now, and Q0 the same at the
// start. A node turns by the mean over the triangles around it. That is no rotation where these turn unlike, but what
// it carries is as short as cloth is thick, and it is one where the surface moves rigidly.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "contact/surface.hpp"
#include "math/buffer.hpp"

namespace sim_core {

class Turns {
 public:
  // A step begins at `start`, which stays where it is.
  void begin(const Buffer<double>& start);
  // The surface is at x, which stays where it is while `of` is asked.
  void move_to(const Buffer<double>& x);
  const Eigen::Matrix3d& of(const Surface& surface, int node);

 private:
  const Eigen::Matrix3d& turn_of(const Surface& surface, int triangle);

  struct Turn {
    int at = 0, start_at = 0;  // the counts of moves, and of starts, that it belongs to
    Eigen::Matrix3d start, turn;
  };
  std::vector<Turn> triangles_, nodes_;
  const Buffer<double>*start_ = nullptr, *x_ = nullptr;
  int starts_ = 0, moves_ = 0;
};

}  // namespace sim_core
