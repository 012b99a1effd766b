// One entry per instruction set that the cloth kernels are compiled for; cloth_kernel.hpp is the code of all of them.
#pragma once

#include "cloth_problem.hpp"

namespace sim_core {

ClothKernel cloth_kernel_baseline();
ClothKernel cloth_kernel_x86_64_v3();
ClothKernel cloth_kernel_x86_64_v4();

// The widest that this processor runs.
ClothKernel best_cloth_kernel();

}  // namespace sim_core
