#include "cloth/kernels/kernel.hpp"

namespace sim_core {

constinit const ClothKernel CLOTH_KERNEL = kernel_named(KERNEL_LEVEL);

}  // namespace sim_core
