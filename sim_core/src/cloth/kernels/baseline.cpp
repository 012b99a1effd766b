#define CLOTH_FLOATS 4
#include "cloth/kernels/kernel.hpp"

namespace sim_core {

constinit const ClothKernel cloth_baseline = kernel_named("baseline");

}  // namespace sim_core
