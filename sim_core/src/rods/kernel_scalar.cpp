#include "rods/kernel.hpp"

namespace sim_core {

constinit const RodKernels rods_scalar = kernels_of<1>("scalar");

}  // namespace sim_core
