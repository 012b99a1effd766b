// Contacts of cloth with itself and with other cloth: the pairs of closest points, their forces from step to step
// (matching.cpp), which of them are active (active_set.cpp), and their rows of Newton's system (linearization.cpp).
#pragma once

#include <Eigen/Core>
#include <vector>

#include "contact/detection.hpp"
#include "contact/state.hpp"

namespace sim_core {

class ContactSet {
 public:
  // `margin`: distance that nodes move before candidates are searched again, m.
  ContactSet(Surface surface, const ContactMaterials& materials, const ContactSettings& settings,
             const PathSettings& path, double margin, int free_nodes);

  double smoothing = 0.0;  // length over which the law is smoothed, m; 0: the exact law
  bool stiff = false;      // along the normals, too

  Neighbourhood& near() { return detection_.near; }
  const std::vector<Pair>& list() const { return pairs_; }

  // Forgets all forces.
  void restart();
  // Begins an attempt at a step from `start`, with the forces kept last. Held nodes go to `ends`; all nodes are
  // `expected` where velocities lead. `own`: stiffness of the free nodes, N/m; `bone_turns`: of the
  // skeletons in the step.
  void begin(const Buffer<double>& start, const Buffer<double>& ends, const Buffer<double>& expected,
             std::vector<Eigen::Matrix3d> own, std::vector<Eigen::Matrix3d> bone_turns);
  // Keeps the forces at the end of a step for the next one.
  void keep();

  // Finds and linearizes the pairs at x, with a share of the forces' last changes, and subtracts their forces from the
  // residual.
  void update(const Buffer<double>& x, double share, Buffer<double>& residual);
  // After the first look of a step: activates pairs that have a force and are open by no more than what a prediction on
  // straight lines opens over curved cloth. Returns whether there are any.
  bool resume();
  // After a linear problem: releases added pairs that would pull, and adds pairs that would come too near, vertices
  // before edges. Returns whether the active set has changed.
  bool activate(const Buffer<float>& change);
  // Takes over the changes of the forces from the solution of the linear problem.
  void solved(const Buffer<float>& change);
  // Marks the pairs at hand as the best; returns to them, without changes.
  void mark_best() { best_.assign(pairs_.begin(), pairs_.end()); }
  void return_to_best();

  // Rows of the active pairs, for products with the matrix, second derivatives of the distance included.
  PairData rows();
  // Subtracts from nodal forces what the pairs contribute to the right-hand side.
  void subtract_right_side(Buffer<float>& force) const;
  // Adds a share of the stiffness by which pairs hold the free nodes, N/m.
  void add_stiffness(double share, std::vector<double>& stiffness) const;
  // Counts the forces by which the law is missed, where this stiffness [N/m] turns gaps and slips into forces.
  void count_errors(double stiffness, Norms& norms) const;

  // Whether a pair is active, or cloth is near cloth: idle pairs with surfaces do not count.
  bool relevant() const;
  const ContactMaterials& materials() const { return detection_.materials; }
  // The skeleton of a pair, or null.
  const Bone* bone_of(const Pair& pair) const { return detection_.bone_of(pair.who); }
  // Least radius over the side of a cell of a skeleton that bears; infinite where none does.
  double sharpest() const;
  // Whether there is a force or an active pair.
  bool active() const;
  // Mean error of the forces by smoothing, N.
  double smoothed_force() const;
  double least_distance() const { return detection_.least_distance(); }

 private:
  void transfer(double share);
  void merge();
  void linearize_at(const Buffer<double>& x);

  ContactSettings settings_;
  int free_nodes_;
  PairDetection detection_;
  std::vector<Pair> pairs_;                   // sorted by kind, first, feature
  std::vector<PairPast> base_, kept_, best_;  // likewise
  std::vector<int> nodes_;                    // of `rows`
  Buffer<float> weights_, stiffness_;
};

}  // namespace sim_core
