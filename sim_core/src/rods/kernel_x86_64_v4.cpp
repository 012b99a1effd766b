#include "rods/kernel.hpp"

namespace sim_core {

constinit const RodKernels rods_x86_64_v4 = kernels_of<8>("x86-64-v4");

}  // namespace sim_core
