#include "rods/kernel.hpp"
#include "rods/kernels.hpp"

namespace sim_core {

SIM_CORE_ROD_KERNEL(solve_rods_x86_64_v4) { solve_range<8, RodReader>(batch, settings, samples, begin, end); }

SIM_CORE_GENERAL_ROD_KERNEL(solve_general_rods_x86_64_v4) {
  solve_range<8, GeneralRodReader>(batch, settings, samples, begin, end);
}

}  // namespace sim_core
