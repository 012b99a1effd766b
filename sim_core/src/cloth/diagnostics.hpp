// Numbers about a cloth and its solver that no step needs: stability, and its matrix.
#pragma once

#include "cloth/newton.hpp"

namespace sim_core {

// K v with the matrix of Newton's method at x, without mass; v and the result are of the free nodes, (free nodes, 4).
Buffer<float> stiffness_times(Assembly& assembly, Newton& newton, const Buffer<double>& x, const Buffer<float>& v);
// The smallest eigenvalue of K v = lambda M v at x, without contact, 1/s^2: positive where x is stable.
double softest_mode(Assembly& assembly, Newton& newton, const Buffer<double>& x);

}  // namespace sim_core
