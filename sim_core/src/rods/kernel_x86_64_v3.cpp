#include "rods/kernel.hpp"

namespace sim_core {

constinit const RodKernels rods_x86_64_v3 = kernels_of<4>("x86-64-v3");

}  // namespace sim_core
