// Contacts of cloth with itself and with other cloth: which pairs of closest points there are, their forces, and their
// rows of Newton's system.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "cloth/problem.hpp"
#include "contact/pair_law.hpp"
#include "contact/pair_settings.hpp"
#include "contact/path.hpp"
#include "contact/state.hpp"
#include "contact/turns.hpp"

namespace sim_core {

struct Pair {
  Candidate who;
  int feature;  // that is closest to a vertex: a triangle, an edge after them, or a node after these; or the second
                // edge
  Eigen::Vector4d weights;
  PairSight sight;
  Eigen::Vector3d middle;  // of the two points, m
  double thickness;        // m
  // The derivatives of the weights by where the closest points lie.
  Eigen::Vector4d along_first, along_second;
  // m: of its motions, by nodes that are held and not yet at their ends
  Eigen::Matrix<double, 9, 1> given = Eigen::Matrix<double, 9, 1>::Zero();
  // Of where the closest points lie, and of the force as the normal turns, by the motions.
  Eigen::Matrix<double, 2, 9> sliding = Eigen::Matrix<double, 2, 9>::Zero();
  Eigen::Matrix<double, 3, 9> turning = Eigen::Matrix<double, 3, 9>::Zero();
  Eigen::Vector3d change = Eigen::Vector3d::Zero();  // of the force by the last linear problem, N
  PairRow row{};
  double insistence = 1.0;               // by which its proximal stiffness has grown in this attempt
  bool added = false, released = false;  // in the linear problem at hand, whatever the law says

  bool bears() const { return row.mode != contact_open; }
  // Of its first point over its second, m, and the change of its force by it, N.
  Eigen::Vector3d motion(const Buffer<float>& change, int free_nodes) const;
  Eigen::Matrix<double, 9, 1> motions(const Buffer<float>& change, int free_nodes) const;
  // C, N/m.
  Eigen::Matrix<double, 9, 9> stiffness() const;
  Eigen::Vector3d force_change(const Buffer<float>& change, int free_nodes) const;
};

// What is kept of a pair: its force, and how well it did.
struct PairPast {
  Candidate who;
  int feature, mode;
  Eigen::Vector3d force, change, normal, middle;
  double thickness, insistence;
  double missed;  // m: by which it missed what its row asked for, if it bore

  PairPast(const Pair& pair);
};

class Pairs {
 public:
  // `margin`: how far nodes move before pairs are looked for anew, m.
  Pairs(Surface surface, const PairSettings& settings, double margin, int free_nodes);

  Neighbourhood near;
  double smoothing = 0.0;  // m: over which the law is smooth; 0 for the exact one
  bool stiff = false;      // along the normals, too

  // Forgets all forces.
  void restart();
  // An attempt at a step begins at `start`, with the forces that were kept last, and takes held nodes to `ends`, and
  // the others to where they are `expected` if nothing stops them; `own`: stiffness of the free nodes, N/m.
  void begin(const Buffer<double>& start, const Buffer<double>& ends, const Buffer<double>& expected,
             std::vector<Eigen::Matrix3d> own);
  // A step ended.
  void keep();

  // Sorts the pairs at x, with a share of the forces' last changes, and takes their forces from the residual.
  void look(const Buffer<double>& x, double share, Buffer<double>& residual);
  // Adds a share of the stiffness by which pairs hold the free nodes, N/m.
  void add_stiffness(double share, std::vector<double>& stiffness) const;
  // After the first look of a step: pairs that have a force and would open by no more than a prediction on straight
  // lines does over a curved cloth bear in the first linear problem. Returns whether there are any.
  bool resume();
  // Counts the forces by which the law is missed, if gaps and slips are held with this stiffness, N/m.
  void count_errors(double stiffness, Norms& norms) const;
  const std::vector<Pair>& list() const { return pairs_; }
  // Whether there is a pair that bears, or cloth that is near cloth. Idle pairs with surfaces only watch.
  bool matter() const;
  // Whether there is a force or a pair that bears.
  bool active() const;

  // After a linear problem: makes pairs bear that would come too near, vertices before edges, and lets go of those
  // added ones that would pull. Returns whether the problem is another one now.
  bool activate(const Buffer<float>& change);
  // Takes over the forces' changes that belong to the solved motion.
  void solved(const Buffer<float>& change);
  // Keeps the pairs at hand as the best; back to them, without changes.
  void mark_best() { best_.assign(pairs_.begin(), pairs_.end()); }
  void return_to_best();

  // The rows, for the product with the matrix; and minus their right-hand side, to be subtracted from the nodes'.
  PairData rows();
  void subtract_right_side(Buffer<float>& force) const;

  int bearing() const;
  // By which forces are off in the mean by smoothing, N.
  double smoothed_force() const;
  // Least distance of any two pieces that do not hang together at the last look, m; infinite where none is near.
  double least_distance() const { return least_distance_; }

 private:
  void select(const Buffer<double>& x);
  void add(const Candidate& who, int feature, const Eigen::Vector4d& weights, const Buffer<double>& x);
  void hand_on(const std::vector<PairPast>& before, double share);
  void merge();

  PairSettings settings_;
  int free_nodes_;
  double least_distance_;
  std::vector<Pair> pairs_;                   // sorted by kind, first, feature
  std::vector<PairPast> base_, kept_, best_;  // likewise
  const Buffer<double>*start_ = nullptr, *ends_ = nullptr;
  Turns turns_;
  std::vector<Eigen::Matrix3d> own_;  // of the free nodes, N/m
  std::vector<int> nodes_;
  Buffer<float> weights_, stiffness_;
};

}  // namespace sim_core
