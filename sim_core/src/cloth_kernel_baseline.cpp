#define CLOTH_FLOATS 4
#include "cloth_kernel.hpp"
#include "cloth_kernels.hpp"

namespace sim_core {

ClothKernel cloth_kernel_baseline() { return kernel_named("baseline", true); }

}  // namespace sim_core
