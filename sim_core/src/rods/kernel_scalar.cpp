#include "rods/kernel.hpp"
#include "rods/kernels.hpp"

namespace sim_core {

SIM_CORE_ROD_KERNEL(solve_rods_scalar) { solve_range<1, RodReader>(batch, settings, samples, begin, end); }

SIM_CORE_GENERAL_ROD_KERNEL(solve_general_rods_scalar) {
  solve_range<1, GeneralRodReader>(batch, settings, samples, begin, end);
}

}  // namespace sim_core
