#define CLOTH_FLOATS 16
#include "cloth/kernels/kernel.hpp"
#include "cloth/kernels/levels.hpp"

namespace sim_core {

ClothKernel cloth_kernel_x86_64_v4() { return kernel_named("x86-64-v4"); }

}  // namespace sim_core
