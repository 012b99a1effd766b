#define CLOTH_FLOATS 8
#include "cloth/kernels/kernel.hpp"

namespace sim_core {

constinit const ClothKernel cloth_x86_64_v3 = kernel_named("x86-64-v3");

}  // namespace sim_core
