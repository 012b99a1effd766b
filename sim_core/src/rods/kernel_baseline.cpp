#include "rods/kernel.hpp"
#include "rods/kernels.hpp"

namespace sim_core {

SIM_CORE_ROD_KERNEL(solve_rods_baseline) { solve_range<2, RodReader>(batch, settings, samples, begin, end); }

SIM_CORE_GENERAL_ROD_KERNEL(solve_general_rods_baseline) {
  solve_range<2, GeneralRodReader>(batch, settings, samples, begin, end);
}

}  // namespace sim_core
