#include "cloth/bending.hpp"

namespace sim_core {

Bending::Bending(const ClothMesh& mesh, const std::vector<Stencil>& stencils, const Fabrics& fabrics,
                 const Numbering& numbering, const Pattern& pattern)
    : fabric_(fabrics.of_triangle) {
  const int count = static_cast<int>(stencils.size());
  for (int t = 0; t < count; ++t) {
    const Stencil& stencil = stencils[t];
    for (std::size_t i = 0; i < stencil.nodes.size(); ++i) {
      nodes_.push_back(numbering.node[stencil.nodes[i]]);
      for (int c = 0; c < 3; ++c) weights_.push_back(stencil.weights(i, c));
      weights_.push_back(0.0);
    }
    slot_begin_.push_back(static_cast<int>(slots_.size() / 2));
    for (std::size_t i = 0; i < stencil.nodes.size(); ++i) {
      for (std::size_t j = 0; j <= i; ++j) {
        const int a = numbering.node[stencil.nodes[i]], b = numbering.node[stencil.nodes[j]];
        slots_.push_back(pattern.slot(a, b));
        slots_.push_back(pattern.slot(b, a));
      }
    }
    begin_.push_back(static_cast<int>(nodes_.size()));
    area_.push_back(mesh.area[t]);
    spacing2_.push_back(2.0 * mesh.area[t]);
  }
  for (const ClothProperties& fabric : fabrics.list) {
    const Rigidity& d = fabric.rigidity;
    rigidity_.insert(rigidity_.end(), {d(0, 0), d(0, 1), d(0, 2), d(1, 1), d(1, 2), d(2, 2)});
  }
  data_ = {count,          begin_.data(),    nodes_.data(),      weights_.data(), area_.data(), spacing2_.data(),
           fabric_.data(), rigidity_.data(), slot_begin_.data(), slots_.data()};
}

}  // namespace sim_core
