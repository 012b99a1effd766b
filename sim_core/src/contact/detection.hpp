// Detection of pairs: closest points of cloth with itself, other cloth and surfaces, and how they have moved.
#pragma once

#include <Eigen/Core>
#include <vector>

#include "contact/materials.hpp"
#include "contact/pair.hpp"
#include "contact/path.hpp"
#include "contact/settings.hpp"
#include "contact/turns.hpp"

namespace sim_core {

class PairDetection {
 public:
  PairDetection(Surface surface, const ContactMaterials& materials, const ContactSettings& settings,
                const PathSettings& path, double margin, int free_nodes);

  Neighbourhood near;
  const ContactMaterials materials;

  // See ContactSet::begin.
  void begin(const Buffer<double>& start, const Buffer<double>& ends, const Buffer<double>& expected,
             std::vector<Eigen::Matrix3d> own, std::vector<Eigen::Matrix3d> bone_turns);
  // Replaces `pairs` by those at x, sorted by kind, first and feature, without forces. `smoothing` [m] and `stiff`: see
  // ContactSet.
  void find(const Buffer<double>& x, double smoothing, bool stiff, std::vector<Pair>& pairs);
  // The skeleton of a pair, or null.
  const Bone* bone_of(const Candidate& pair) const;
  // Least distance of any two pieces without a common node at the last search, m; infinite where none is near.
  double least_distance() const { return least_distance_; }

 private:
  void find_vertices(std::vector<Candidate>& candidates, double reach, const Buffer<double>& x,
                     std::vector<Pair>& pairs);
  void find_edges(std::vector<Candidate>& candidates, double reach, const Buffer<double>& x, std::vector<Pair>& pairs);
  void add(const Candidate& who, int feature, const Eigen::Vector4d& weights, const Buffer<double>& x,
           std::vector<Pair>& pairs);
  Eigen::Vector3d slip(const Candidate& who, const Eigen::Vector4d& weights, const Eigen::Vector3d& rho);

  ContactSettings settings_;
  int free_nodes_;
  double least_distance_, smoothing_ = 0.0;
  bool stiff_ = false;
  const Buffer<double>*start_ = nullptr, *ends_ = nullptr;
  Turns turns_;
  std::vector<Eigen::Matrix3d> bone_turns_;
  std::vector<Eigen::Matrix3d> own_;  // stiffness of the free nodes, N/m
};

}  // namespace sim_core
