// What cloth is made of.
#pragma once

#include <Eigen/Core>

#include "cloth/plate.hpp"

namespace sim_core {

// Stiffness against stretching after [Wang et al. 2011]: k0 ... k3 [N/m] of the energy k0 G00^2/2 + k1 G00 G11 +
// k2 G11^2/2 + k3 G01^2. Row 0 holds at no strain, rows 1 ... 5 at `table_stretch` with the larger principal stretch
// 0, 22.5, ..., 90 degrees from the first axis; in between it is bilinear.
struct StretchTable {
  Eigen::Matrix<double, 6, 4, Eigen::RowMajor> k;
  bool constant() const;
};
constexpr double table_stretch = 1.0 / 6.0;

struct ClothProperties {
  double density;  // kg/m^2
  StretchTable stretching;
  Rigidity rigidity;
};

}  // namespace sim_core
