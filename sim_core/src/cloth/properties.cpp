#include "cloth/properties.hpp"

#include <utility>

#include "cloth/refusal.hpp"

namespace sim_core {

Fabrics::Fabrics(const ClothMesh& mesh, std::vector<ClothProperties> list_in) : list(std::move(list_in)) {
  if (list.size() != 1 && static_cast<int>(list.size()) != mesh.sheets) {
    refuse(text("fabric: must be one, or one for each of ", mesh.sheets, " sheets, got ", list.size()));
  }
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    of_triangle.push_back(list.size() == 1 ? 0 : mesh.sheet_of_vertex[mesh.triangles(t, 0)]);
  }
}

}  // namespace sim_core
