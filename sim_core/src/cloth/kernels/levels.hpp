// What each level's unit defines.
#pragma once

#include "cloth/problem.hpp"

namespace sim_core {

ClothKernel cloth_kernel_baseline();
ClothKernel cloth_kernel_x86_64_v3();
ClothKernel cloth_kernel_x86_64_v4();

}  // namespace sim_core
