#include "rods/kernel.hpp"

namespace sim_core {

constinit const RodKernels rods_baseline = kernels_of<2>("baseline");

}  // namespace sim_core
