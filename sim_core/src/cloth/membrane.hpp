// Stretching: triangles in groups of one fabric, and the law of each fabric.
#pragma once

#include "cloth/numbering.hpp"
#include "cloth/problem.hpp"
#include "cloth/properties.hpp"
#include "math/buffer.hpp"

namespace sim_core {

class Membrane {
 public:
  Membrane(const ClothMesh& mesh, const Numbering& numbering, const Fabrics& fabrics);
  Membrane(const Membrane&) = delete;

  const MembraneData& data() const { return data_; }
  void lag_from(const ClothKernel& kernel, const double* x, double share);

 private:
  Buffer<int> nodes_, slots_, fabric_;
  Buffer<double> shape_, area_, law_, lag_;
  Buffer<char> tabulated_;
  MembraneData data_{};
};

}  // namespace sim_core
