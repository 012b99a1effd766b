// Where a sheet passes through itself.
#pragma once

#include "cloth/mesh.hpp"

namespace sim_core {

// Number of pairs of triangles without a common vertex of which an edge of one crosses the other.
int self_intersections(const Points3& positions, const Triangles& triangles);

}  // namespace sim_core
