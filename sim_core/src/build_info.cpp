#include "build_info.hpp"

#include <cstdlib>

#include "build_constants.hpp"
#include "cloth/kernels/choice.hpp"
#include "rods/rods.hpp"

namespace sim_core {

BuildInfo build_info() {
  const char* pinned = std::getenv("STICKSLIP_CLOTH_KERNEL");
  const std::string isa = SIM_CORE_BUILD_ISA;
  return {SIM_CORE_VERSION,          SIM_CORE_BUILD_HASH,
          SIM_CORE_BUILD_COMPILER,   isa.empty() ? SIM_CORE_BUILD_PROCESSOR : isa,
          rod_kernels().back().name, cloth_kernel_named(pinned ? pinned : "").name,
          SIM_CORE_BUILD_EIGEN};
}

}  // namespace sim_core
