// Stretching: triangles in groups, and the table of their stiffness.
#pragma once

#include <vector>

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

  // Reads the table at the strain of the positions x (nodes, 4).
  void read_table(const Buffer<double>& x);

 private:
  void read_table(const Buffer<double>& x, int group, int lane);

  std::vector<StretchTable> tables_;  // of the triangles
  bool constant_;
  Buffer<int> nodes_, slots_;
  Buffer<double> shape_, area_, stiffness_;
  MembraneData data_{};
};

}  // namespace sim_core
