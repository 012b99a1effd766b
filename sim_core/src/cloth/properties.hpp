// What cloth is made of.
#pragma once

#include <Eigen/Core>
#include <utility>
#include <vector>

#include "cloth/mesh.hpp"
#include "cloth/problem.hpp"
#include "cloth/refusal.hpp"

namespace sim_core {

using Rigidity = Eigen::Matrix3d;  // D of (H11, H22, 2 H12), N m

// Stiffness against stretching after [Wang et al. 2011]: k0 ... k3 [N/m] of the energy k0 G00^2/2 + k1 G00 G11 +
// k2 G11^2/2 + k3 G01^2. Row 0 holds at no strain, rows 1 ... 5 at `table_stretch` with the larger principal stretch
// 0, 22.5, ..., 90 degrees from the first axis; kernels/stretching.hpp has the law in between.
using StretchTable = Eigen::Matrix<double, 6, 4, Eigen::RowMajor>;

struct ClothProperties {
  double density;  // kg/m^2
  StretchTable stretching;
  Rigidity rigidity;
  double damping;  // proportional to mass, 1/s
};

// The fabrics of a cloth: one for all of its sheets, or one for each.
struct Fabrics {
  std::vector<ClothProperties> list;
  std::vector<int> of_triangle;

  // Throws std::invalid_argument, naming `fabric`, where there are too many or too few.
  Fabrics(const ClothMesh& mesh, std::vector<ClothProperties> list_in) : list(std::move(list_in)) {
    if (list.size() != 1 && static_cast<int>(list.size()) != mesh.sheets) {
      refuse(text("fabric: must be one, or one for each of ", mesh.sheets, " sheets, got ", list.size()));
    }
    for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
      of_triangle.push_back(list.size() == 1 ? 0 : mesh.sheet_of_vertex[mesh.triangles(t, 0)]);
    }
  }
  const ClothProperties& at(Eigen::Index triangle) const { return list[of_triangle[triangle]]; }
};

}  // namespace sim_core
