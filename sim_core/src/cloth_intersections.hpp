// Where a sheet passes through itself.
#pragma once

#include "cloth_mesh.hpp"
#include "cloth_solver.hpp"

namespace sim_core {

// Number of pairs of triangles without a common vertex of which an edge of one crosses the other.
int self_intersections(const Points3& positions, const Triangles& triangles);

}  // namespace sim_core
