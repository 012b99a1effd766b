// Contacts of the nodes with bodies and smooth surfaces: modes, rows of Newton's system, and what is kept from step to
// step.
#pragma once

#include <Eigen/Core>
#include <memory>
#include <vector>

#include "cloth/problem.hpp"
#include "contact/bodies.hpp"
#include "contact/law.hpp"
#include "contact/settings.hpp"
#include "contact/smooth.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// How far an iterate is from the solution: the largest force that a node lacks [N], and the sum of their squares.
struct Norms {
  double largest = 0.0, squared = 0.0;
  void count(double force_squared);
};

class ContactState {
 public:
  // `law_stiffness`: k of the law over a node's own stiffness.
  explicit ContactState(int free_nodes, const NodeSettings& settings = {}, double law_stiffness = 0.1);

  std::vector<int> mode, touched;  // (free nodes): ContactMode, and the body, or after them the surface (-1: none)
  std::vector<int> sheet;          // (free nodes): to which they belong
  std::vector<double> stiffness;   // (free nodes): k of the law, N/m
  Buffer<float> normal, direction, mu, turning;
  Buffer<float> force, correction;  // (free nodes, 4): the right-hand side, N, and what contact prescribes, m

  std::vector<char> whole_skeletons;  // (bodies): those that nodes do not feel; none: all are felt
  bool by_pairs(std::size_t body) const { return body < whole_skeletons.size() && whole_skeletons[body]; }
  std::unique_ptr<SmoothContact> surfaces;  // null if there are none

  // Whether nodes whose friction turns back from one iterate to the next stick in the linear problem. Newton's method
  // may else go to and fro between the two ways of slipping, where the law has it that they stick.
  bool hold_reversed = false;

  // Sorts the free nodes at `x`, which were at `start` when the step began and need `residual` from contact.
  Norms sort(const Buffer<double>& x, const Buffer<double>& start, const Buffer<double>& residual,
             const std::vector<Body>& at_start, const std::vector<Body>& at_end);

  // Puts the nodes that were in contact at the end of the last step back into the mode and direction they had, for the
  // first linear problem of a step of dt: at a predicted state the law would sort many of them wrongly.
  bool resume(const Buffer<double>& x, const Buffer<double>& start, const Buffer<double>& residual,
              const std::vector<Body>& at_start, const std::vector<Body>& at_end, double dt);
  // Keeps the modes, directions and stiffnesses of a step that ended, for the next; or none.
  void keep(double dt);
  void forget();

  ContactRows rows() const;

  // Contact of a node as a penalty, for factors: xx xy xz yy yz zz, N/m. k n n^T where it slips, and against a turn of
  // friction; k in all directions where it sticks; k by the node's own stiffness.
  void penalty(int node, double own, float* out) const;

 private:
  ContactKinematics kinematics(int node, int body, const Gap& gap, const Buffer<double>& x, const Buffer<double>& start,
                               const Buffer<double>& residual, const std::vector<Body>& at_start,
                               const std::vector<Body>& at_end) const;
  void write(int node, const ContactLinearization& row);

  struct Kept {
    std::vector<int> mode, touched;
    Buffer<float> direction, turning;
    double dt = 0.0;  // 0: nothing is kept
  };
  Kept kept_;
  NodeSettings settings_;
  double turning_max_;
};

}  // namespace sim_core
