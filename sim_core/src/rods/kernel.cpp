#include "rods/kernel.hpp"

namespace sim_core {

constinit const RodKernels ROD_KERNELS = kernels_of<ROD_LANES>(KERNEL_LEVEL);

}  // namespace sim_core
