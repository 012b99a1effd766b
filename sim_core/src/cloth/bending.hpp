// Bending: the stencils of the plate element, laid out for the kernels.
#pragma once

#include <vector>

#include "cloth/numbering.hpp"
#include "cloth/problem.hpp"
#include "cloth/properties.hpp"
#include "math/buffer.hpp"

namespace sim_core {

class Bending {
 public:
  Bending(const ClothMesh& mesh, const std::vector<Stencil>& stencils, const Fabrics& fabrics,
          const Numbering& numbering, const Pattern& pattern);
  Bending(const Bending&) = delete;

  const BendingData& data() const { return data_; }

 private:
  std::vector<int> begin_{0}, nodes_, slot_begin_, slots_, fabric_;
  Buffer<double> weights_;
  std::vector<double> area_, spacing2_, rigidity_;
  BendingData data_{};
};

}  // namespace sim_core
