// Two entries, uniform and general rods, per instruction set that the rod solver is compiled for; kernel.hpp is the
// code of all of them.
#pragma once

#include "rods/general_rods.hpp"
#include "rods/rods.hpp"

namespace sim_core {

#define SIM_CORE_ROD_KERNEL(name)                                                                        \
  void name(const RodBatch& batch, const RodSettings& settings, const std::vector<SamplePoint>& samples, \
            std::int64_t begin, std::int64_t end)

#define SIM_CORE_GENERAL_ROD_KERNEL(name)                                                                       \
  void name(const GeneralRodBatch& batch, const RodSettings& settings, const std::vector<SamplePoint>& samples, \
            std::int64_t begin, std::int64_t end)

SIM_CORE_ROD_KERNEL(solve_rods_scalar);
SIM_CORE_ROD_KERNEL(solve_rods_baseline);
SIM_CORE_ROD_KERNEL(solve_rods_x86_64_v3);
SIM_CORE_ROD_KERNEL(solve_rods_x86_64_v4);
SIM_CORE_GENERAL_ROD_KERNEL(solve_general_rods_scalar);
SIM_CORE_GENERAL_ROD_KERNEL(solve_general_rods_baseline);
SIM_CORE_GENERAL_ROD_KERNEL(solve_general_rods_x86_64_v3);
SIM_CORE_GENERAL_ROD_KERNEL(solve_general_rods_x86_64_v4);

}  // namespace sim_core
