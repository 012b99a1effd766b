// Which kernels of the cloth run.
#pragma once

#include <string>
#include <vector>

#include "cloth/problem.hpp"

namespace sim_core {

// The level of this name, or, where it is empty, the widest that this processor runs. Throws std::invalid_argument,
// naming `kernel`, where this build has no such level or this processor cannot run it.
ClothKernel cloth_kernel_named(const std::string& name);

// Names of the levels that this build has and this processor runs, narrowest first.
std::vector<std::string> cloth_kernels();

}  // namespace sim_core
