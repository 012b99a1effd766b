#define CLOTH_FLOATS 8
#include "cloth_kernel.hpp"
#include "cloth_kernels.hpp"

namespace sim_core {

ClothKernel cloth_kernel_x86_64_v3() { return kernel_named("x86-64-v3", true); }

}  // namespace sim_core
