#define CLOTH_FLOATS 16
#include "cloth/kernels/kernel.hpp"

namespace sim_core {

constinit const ClothKernel cloth_x86_64_v4 = kernel_named("x86-64-v4");

}  // namespace sim_core
