#define CLOTH_FLOATS 8
#include "cloth/kernels/kernel.hpp"
#include "cloth/kernels/levels.hpp"

namespace sim_core {

ClothKernel cloth_kernel_x86_64_v3() { return kernel_named("x86-64-v3"); }

}  // namespace sim_core
