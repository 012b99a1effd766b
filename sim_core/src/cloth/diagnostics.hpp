// Numbers about a cloth and its solver that no step needs: stability, and errors of matrices and factors.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include "cloth/newton.hpp"

namespace sim_core {

// K v with the matrix of Newton's method at x, without mass; v and the result are of the free nodes, (free nodes, 4).
Buffer<float> stiffness_times(Assembly& assembly, Newton& newton, const Buffer<double>& x, const Buffer<float>& v);
// The smallest eigenvalue of K v = lambda M v at x, without contact, 1/s^2: positive where x is stable.
double softest_mode(Assembly& assembly, Newton& newton, const Buffer<double>& x);
// Relative error of a solve with the factor of the matrix's neighbour for a step of dt [s], where no node is in
// contact.
double factor_error(Assembly& assembly, Newton& newton, const Buffer<double>& x, double dt);
// Largest difference between a factor whose parts that hold the `sticking` nodes were made anew, and a whole one, over
// its largest number; and the share that was made.
std::pair<double, double> part_error(Assembly& assembly, Newton& newton, const Buffer<double>& x,
                                     const std::vector<int>& sticking, double dt);

}  // namespace sim_core
