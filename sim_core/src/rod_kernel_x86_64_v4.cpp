#include "rod_kernel.hpp"
#include "rod_kernels.hpp"

namespace sim_core {

SIM_CORE_ROD_KERNEL(solve_rods_x86_64_v4) { solve_range<8>(batch, settings, samples, begin, end); }

}  // namespace sim_core
