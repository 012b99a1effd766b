#include "rod_kernel.hpp"
#include "rod_kernels.hpp"

namespace sim_core {

SIM_CORE_ROD_KERNEL(solve_rods_x86_64_v3) { solve_range<4>(batch, settings, samples, begin, end); }

}  // namespace sim_core
