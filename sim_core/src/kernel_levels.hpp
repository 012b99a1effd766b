// Levels of the kernels: what is compiled for one instruction set, and which of them run.
#pragma once

#include <string>
#include <vector>

#include "cloth/problem.hpp"
#include "rods/rods.hpp"

namespace sim_core {

struct KernelLevel {
  ClothKernel cloth;
  RodKernels rods;
};

// Those that this build has and this processor runs, narrowest first.
std::vector<KernelLevel> kernel_levels();

// Their names.
std::vector<std::string> kernel_names();

// That of this name, or, if it is empty, the widest. Throws std::invalid_argument, naming `kernel`.
KernelLevel kernel_level(const std::string& name);

}  // namespace sim_core
