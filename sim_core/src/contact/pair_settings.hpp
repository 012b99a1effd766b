// What contacts of cloth with cloth are told.
#pragma once

#include <Eigen/Core>
#include <vector>

namespace sim_core {

// Of sheets and surfaces.
struct PairSettings {
  std::vector<double> thickness;  // m: two keep the mean of theirs apart
  Eigen::MatrixXd mu;             // of each two; negative where they do not feel each other
};

}  // namespace sim_core
