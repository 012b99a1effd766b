// Contacts of cloth with itself, with other cloth and with surfaces: the pairs of closest points
// (detection.cpp), their forces from step to step (matching.cpp), which of them are active, and
// their rows of Newton's system.
#pragma once

#include <Eigen/Core>
#include <optional>
#include <span>
#include <vector>

#include "contact/linearized_contact.hpp"
#include "contact/path.hpp"
#include "contact/rows.hpp"
#include "contact/state.hpp"
#include "contact/surface.hpp"

namespace sim_core {

// (m, m_1, m_2): motions of the pair's first point over its second, and of its two pieces along
// themselves, m.
using PairMotions = Eigen::Matrix<double, 9, 1>;

// One pair of closest points: its geometry, its force, and its part of Newton's system.
struct Pair {
  Candidate stencil;
  int feature;  // closest to a vertex, by `FeatureNumbers` (detection.cpp); or the second edge
  Eigen::Vector4d weights;
  Contact contact;
  ProximalStiffness proximal;
  double smoothing_energy;  // epsilon, J: 0 under the exact law
  Eigen::Vector3d middle;   // of the two points, m
  double thickness;         // m: that it keeps apart
  // Derivatives of the weights by the places of the closest points on their pieces.
  Eigen::Vector4d along_first, along_second;
  // Part of its motions that held nodes still have to make, m.
  PairMotions held_motions = PairMotions::Zero();
  // Derivatives by the motions: of the places of the closest points, and of the force as the normal
  // turns.
  Eigen::Matrix<double, 2, 9> sliding = Eigen::Matrix<double, 2, 9>::Zero();
  Eigen::Matrix<double, 3, 9> force_by_motions = Eigen::Matrix<double, 3, 9>::Zero();
  Eigen::Vector3d change = Eigen::Vector3d::Zero();  // of the force in the last linear problem, N
  PairRow row{};
  double proximal_growth = 1.0;          // growth of its proximal stiffness in this attempt
  std::optional<Cone> cone = {};         // of friction; none before it is chosen
  bool added = false, released = false;  // in the linear problem at hand, whatever the law says

  bool active() const { return row.mode != contact_open; }
  // The law that holds for it now.
  LawResponse law() const;
  // Motion of its first point over its second, m; all of its motions; and the change of its force
  // by them, N.
  Eigen::Vector3d motion(const Buffer<float>& change, int free_nodes) const;
  PairMotions motions(const Buffer<float>& change, int free_nodes) const;
  Eigen::Vector3d force_change(const Buffer<float>& change, int free_nodes) const;
  // C, N/m.
  Eigen::Matrix<double, 9, 9> stiffness() const;
};

// Pairs in the plain arrays that kernels read.
class PairArrays {
 public:
  void clear();
  void add(const Pair& pair, int free_nodes);
  PairData data() const;

 private:
  std::vector<int> nodes_;
  Buffer<float> weights_, stiffness_;
};

// Record of a pair at an earlier iterate.
struct PairPast {
  Candidate stencil;
  int feature, mode;
  Eigen::Vector3d force, change, normal, middle;
  double thickness, proximal_growth;
  double missed;             // violation of its row, m; see `violation`
  std::optional<Cone> cone;  // as of a pair

  PairPast(const Pair& pair);
};

// Length by which an active pair violates its row: gap and, where it sticks, slip, m.
double violation(const Contact& contact, int mode);

class ContactSet {
 public:
  // `skin`: distance that nodes move before candidates are searched again, m.
  ContactSet(Surface surface, const ContactMaterials& materials, double skin, int free_nodes);

  double smoothing = 0.0;  // length over which the law is smoothed, m; 0: the exact law
  bool stiff = false;      // along the normals, too

  CandidateSet near;
  const ContactMaterials materials;
  const std::vector<Pair>& list() const { return pairs_; }

  // Forgets all forces.
  void restart();
  // Forgets what slid, too: another state is set.
  void forget_cones() { ended_.clear(); }
  // Begins an attempt at a step from `start`, with the forces kept last. Held nodes go to `ends`;
  // all nodes are `expected` where velocities lead. `own_blocks` has the stiffness of each free
  // node, N/m.
  void begin(const Buffer<double>& start, const Buffer<double>& ends,
             const Buffer<double>& expected, std::vector<Eigen::Matrix3d> own_blocks);
  // After a step was solved: gives pairs the cones that hold now, and keeps their forces for the
  // next look. Returns whether any changed.
  bool switch_cones();
  // Keeps the forces at the end of a step for the next one.
  void store_history();

  // Finds and linearizes the pairs at x, with a step length along the forces' last changes, and
  // subtracts their forces from the residual.
  void update(const Buffer<double>& x, double step_length, Buffer<double>& residual);
  // After the first look of a step: activates pairs that have a force and are open by no more than
  // what a prediction on straight lines opens over curved cloth. Returns whether there are any.
  bool warm_start();
  // After a linear problem: releases added pairs that would pull, and adds pairs that would come
  // too near, vertices before edges. Returns whether the active set has changed.
  bool activate(const Buffer<float>& change);
  // Takes over the changes of the forces from the solution of the linear problem.
  void solved(const Buffer<float>& change);
  // Marks the pairs at hand as the best; returns to them, without changes.
  void mark_best() { best_.assign(pairs_.begin(), pairs_.end()); }
  void return_to_best();

  // Rows of the active pairs, for products with the matrix, second derivatives of the distance
  // included.
  PairData rows();
  // Subtracts from nodal forces what the pairs contribute to the right-hand side.
  void subtract_right_side(Buffer<float>& force) const;
  // Adds a fraction of the stiffness by which pairs hold the free nodes, N/m.
  void add_stiffness(double fraction, std::vector<double>& stiffness) const;
  // Counts the forces by which the law is missed, where this stiffness [N/m] turns gaps and slips
  // into forces.
  void count_errors(double stiffness, ForceNorms& norms) const;

  // By how much a pair's vector rho turns in the step: with a body or surface, or half with each
  // sheet.
  Eigen::Matrix3d turn_of(const Candidate& stencil, const Eigen::Vector4d& weights);
  // Whether a pair is active, or cloth is near cloth: idle pairs with surfaces do not count.
  bool relevant() const;
  // Whether there is a force or an active pair.
  bool active() const;
  // Mean error of the forces by smoothing, N.
  double smoothed_force() const;
  // Least distance of any two pieces without a common node at the last search, m; infinite where
  // none is near.
  double least_distance() const { return least_distance_; }

 private:
  // Replaces the pairs by those at x, without forces.
  void find(const Buffer<double>& x);
  void find_vertices(std::vector<Candidate>& candidates, double range, const Buffer<double>& x);
  // The pairs of one vertex, from all of its candidates, up to a distance, m.
  void find_vertex(std::span<Candidate> candidates, double reach, const Buffer<double>& x);
  void find_edges(std::vector<Candidate>& candidates, double range, const Buffer<double>& x);
  int feature_of(const Candidate& stencil, const Eigen::Vector4d& weights) const;
  int triangles_around(int feature) const;
  bool has_reverse(int vertex, int feature) const;
  // Of a pair, m/N: with the mean stiffness of its nodes, and with that along the normal.
  struct Compliance {
    double mean, along_normal;
  };
  Compliance compliance(const Candidate& stencil, const Eigen::Vector4d& weights,
                        const Eigen::Vector3d& normal) const;
  ProximalStiffness proximal_stiffness(const Compliance& compliance) const;
  PairMotions held_motions(const Candidate& stencil, const Eigen::Vector4d& weights,
                           const Eigen::Vector4d& along_first, const Eigen::Vector4d& along_second,
                           const Buffer<double>& x) const;
  void add(const Candidate& stencil, int feature, const Eigen::Vector4d& weights,
           const Buffer<double>& x);
  Eigen::Vector3d slip(const Candidate& stencil, const Eigen::Vector4d& weights,
                       const Eigen::Vector3d& rho);
  void transfer(double step_length);
  void inherit(Pair& pair, const PairPast& past, double step_length) const;
  void adopt(const PairPast& orphan, const Eigen::Vector3d& force,
             const std::vector<std::size_t>& fresh);
  void merge();
  void choose_cones();
  Cone cone_at_start(const Pair& pair);
  Eigen::Vector3d expected_slip(const Pair& pair);
  bool has_static(const Pair& pair) const;
  void linearize_at(const Buffer<double>& x);

  // A triangle whose closest point to a vertex lies on this feature.
  struct NearFeature {
    int feature;
    const Candidate* candidate;
    Eigen::Vector4d weights;
  };

  int free_nodes_;
  double least_distance_;
  std::vector<double> displacements_;  // of each node in the step but for a common one, m
  const Buffer<double>*start_ = nullptr, *ends_ = nullptr;
  bool has_static_;          // whether friction of any two is larger while they rest
  Buffer<double> expected_;  // (nodes, 4): where velocities lead, if so, m
  Turns turns_;
  std::vector<Eigen::Matrix3d> own_blocks_;
  std::vector<NearFeature> near_features_;       // of the vertex at hand
  std::vector<Pair> pairs_;                      // sorted by kind, first, feature
  std::vector<PairPast> base_, history_, best_;  // likewise
  std::vector<PairPast> ended_;  // at the end of the last step, if friction is larger at rest
  PairArrays rows_;
};

}  // namespace sim_core
