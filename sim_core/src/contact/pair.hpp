// One pair of closest points: its geometry, its force, and its part of Newton's system.
#pragma once

#include <Eigen/Core>

#include "cloth/problem.hpp"
#include "contact/candidates.hpp"
#include "contact/pair_law.hpp"

namespace sim_core {

// (m, m_1, m_2): motions of the pair's first point over its second, and of its two pieces along themselves, m.
using PairMotions = Eigen::Matrix<double, 9, 1>;

struct Pair {
  Candidate who;
  int feature;  // closest to a vertex: a triangle, an edge (counted after the triangles) or a node (after the edges);
                // or the second edge
  Eigen::Vector4d weights;
  PairKinematics at;
  Eigen::Vector3d middle;  // of the two points, or with a skeleton that of the cloth, m
  double thickness;        // m: that it keeps apart
  double scale;            // m: that of the cloth, which is less with a skeleton
  // Derivatives of the weights by the places of the closest points on their pieces.
  Eigen::Vector4d along_first, along_second;
  // Part of its motions that held nodes still have to make, m.
  PairMotions given = PairMotions::Zero();
  // Derivatives by the motions: of the places of the closest points, and of the force as the normal turns.
  Eigen::Matrix<double, 2, 9> sliding = Eigen::Matrix<double, 2, 9>::Zero();
  Eigen::Matrix<double, 3, 9> turning = Eigen::Matrix<double, 3, 9>::Zero();
  Eigen::Vector3d change = Eigen::Vector3d::Zero();  // of the force in the last linear problem, N
  PairLinearization row{};
  double penalty_scale = 1.0;            // growth of its proximal stiffness in this attempt
  bool added = false, released = false;  // in the linear problem at hand, whatever the law says

  bool active() const { return row.mode != contact_open; }
  // Motion of its first point over its second, m; all of its motions; and the change of its force by them, N.
  Eigen::Vector3d motion(const Buffer<float>& change, int free_nodes) const;
  PairMotions motions(const Buffer<float>& change, int free_nodes) const;
  Eigen::Vector3d force_change(const Buffer<float>& change, int free_nodes) const;
  // C, N/m.
  Eigen::Matrix<double, 9, 9> stiffness() const;
};

// Record of a pair at an earlier iterate.
struct PairPast {
  Candidate who;
  int feature, mode;
  Eigen::Vector3d force, change, normal, middle;
  double scale, penalty_scale;
  double missed;  // violation of its row, m; see `violation`

  PairPast(const Pair& pair);
};

// Length by which an active pair violates its row: gap and, where it sticks, slip, m.
double violation(const PairKinematics& at, int mode);

}  // namespace sim_core
