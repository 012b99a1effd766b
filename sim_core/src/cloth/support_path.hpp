// Where bodies and surfaces are within a step.
#pragma once

#include <vector>

#include "contact/bodies.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// At equal times from the start of a step to its end, and one more; none where they move so evenly
// that friction follows them.
struct SupportPath {
  std::vector<std::vector<Body>> bodies;  // by time
  std::vector<Points3> surfaces;          // by time: (vertices of surfaces, 3), m

  bool empty() const { return bodies.empty(); }
  int parts() const { return static_cast<int>(bodies.size()) - 2; }
};

}  // namespace sim_core
