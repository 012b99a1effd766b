#include "cloth/landings.hpp"

#include <algorithm>

#include "cloth/friction_turns.hpp"

namespace sim_core {

using Eigen::Vector3d;

Landings::Landings(const ClothMesh& mesh, const Numbering& numbering) {
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    for (int c = 0; c < 3; ++c) corners_.push_back(numbering.node[mesh.triangles(t, c)]);
  }
}

bool Landings::lands(int node, const SolvedStep& step) const {
  return step.newton.contact.mode[node] != contact_open && step.velocities.was_free(node);
}

double Landings::largest_way(const SolvedStep& step) const {
  const int free_nodes = step.numbering.free_nodes;
  const Buffer<double>& start = step.problem.start;
  std::vector<int> landing;
  for (int i = 0; i < free_nodes; ++i) {
    if (lands(i, step)) landing.push_back(i);
  }
  if (landing.empty()) return 0.0;
  std::vector<Vector3d> across(step.numbering.nodes, Vector3d::Zero());  // the sheet, m^2
  for (std::size_t t = 0; t < corners_.size(); t += 3) {
    const Vector3d p = at_node(start, corners_[t]);
    const Vector3d normal =
        (at_node(start, corners_[t + 1]) - p).cross(at_node(start, corners_[t + 2]) - p);
    for (int c = 0; c < 3; ++c) across[corners_[t + c]] += normal;
  }
  double largest = 0.0;
  for (const int node : landing) {
    const Vector3d n = at_node(step.newton.contact.normal, node).cast<double>();
    const Vector3d m = across[node].normalized();
    const Vector3d way =
        at_node(step.problem.inertia.guess, node) - at_node(start, node) - carried_by(node, step);
    largest = std::max(largest, -way.dot(n) * (n - n.dot(m) * m).norm());
  }
  return largest;
}

}  // namespace sim_core
