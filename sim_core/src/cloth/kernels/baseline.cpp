#define CLOTH_FLOATS 4
#include "cloth/kernels/kernel.hpp"
#include "cloth/kernels/levels.hpp"

namespace sim_core {

ClothKernel cloth_kernel_baseline() { return kernel_named("baseline"); }

}  // namespace sim_core
