#include "rod_kernel.hpp"
#include "rod_kernels.hpp"

namespace sim_core {

SIM_CORE_ROD_KERNEL(solve_rods_baseline) { solve_range<2>(batch, settings, samples, begin, end); }

}  // namespace sim_core
