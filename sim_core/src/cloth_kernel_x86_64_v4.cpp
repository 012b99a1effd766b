#define CLOTH_FLOATS 16
#include "cloth_kernel.hpp"
#include "cloth_kernels.hpp"

namespace sim_core {

ClothKernel cloth_kernel_x86_64_v4() { return kernel_named("x86-64-v4", true); }

}  // namespace sim_core
