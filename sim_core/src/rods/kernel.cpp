#include "rods/kernel.hpp"

namespace sim_core {

constinit const RodKernels ROD_KERNELS = kernels_of<ROD_LANES>();

}  // namespace sim_core
