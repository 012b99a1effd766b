#include "cloth/properties.hpp"

#include <algorithm>
#include <utility>

#include "cloth/refusal.hpp"

namespace sim_core {

bool StretchTable::constant() const {
  for (int r = 1; r < 6; ++r) {
    if (k.row(r) != k.row(0)) return false;
  }
  return true;
}

Fabrics::Fabrics(const ClothMesh& mesh, std::vector<ClothProperties> list_in) : list(std::move(list_in)) {
  const std::vector<int> sheets = mesh.sheets();
  const int count = 1 + *std::max_element(sheets.begin(), sheets.end());
  if (list.size() != 1 && static_cast<int>(list.size()) != count) {
    refuse(text("fabric: must be one, or one for each of ", count, " sheets, got ", list.size()));
  }
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    of_triangle.push_back(list.size() == 1 ? 0 : sheets[mesh.triangles(t, 0)]);
  }
}

}  // namespace sim_core
