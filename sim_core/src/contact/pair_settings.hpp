// What contacts of cloth with cloth and surfaces are told.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <vector>

namespace sim_core {

// Of sheets and surfaces.
struct PairSettings {
  std::vector<double> thickness;  // m: two keep the mean of theirs apart
  Eigen::MatrixXd mu;             // of each two; negative where they do not feel each other
  int sheets;                     // that come before the surfaces

  // What pairs of closest points keep apart, m. Nodes feel surfaces by themselves: pairs only catch what comes nearer
  // between the nodes than the facets of a curved surface do.
  double apart(int a, int b) const {
    constexpr double surface_share = 0.25;
    const double mean = 0.5 * (thickness[a] + thickness[b]);
    return std::max(a, b) < sheets ? mean : surface_share * mean;
  }
};

}  // namespace sim_core
