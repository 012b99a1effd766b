// How a surface turns in a step: a rotation at each node, so that what wanders over the surface is carried by one that
// changes without a jump from one triangle to the next.
//
// A triangle turns by Q Q0^T, with Q = [a, n x a, n] of its first side and its normal where it was expected, and Q0 the
// same at the start. A node turns by the mean over the triangles around it. That is no rotation where these turn
// unlike, but what it carries is as short as cloth is thick, and it is one where the surface moves rigidly.
//
// The end of the step is taken as velocities lead there, lest a law that carries by it should have derivatives by all
// nodes around: what this misses is of the order dt^2, and none of it is left where motion ends. Turns of free nodes
// that are large fade out.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "contact/surface.hpp"
#include "math/buffer.hpp"

namespace sim_core {

class Turns {
 public:
  // `turn_max`: angle up to which the turn of a free node counts, rad; from twice that it does not.
  explicit Turns(double turn_max) : turn_max_(turn_max) {}

  // A step begins at `start` and is expected to end at `expected`. The nodes behind the free ones go there surely.
  void begin(const Buffer<double>& start, const Buffer<double>& expected, int free_nodes);
  const Eigen::Matrix3d& of(const Surface& surface, int node);

 private:
  const Eigen::Matrix3d& turn_of(const Surface& surface, int triangle);

  struct Turn {
    int step = 0;  // to which it belongs
    Eigen::Matrix3d turn;
  };
  double turn_max_;
  std::vector<Turn> triangles_, nodes_;
  Buffer<double> start_, expected_;
  int step_ = 0, free_nodes_ = 0;
};

}  // namespace sim_core
