#include "kernel_levels.hpp"

#include "math/refusal.hpp"

namespace sim_core {

std::vector<KernelLevel> kernel_levels() {
  std::vector<KernelLevel> out{{cloth_baseline, rods_baseline}};
#ifdef SIM_CORE_X86_64_KERNELS
  __builtin_cpu_init();
  if (__builtin_cpu_supports("x86-64-v3")) out.push_back({cloth_x86_64_v3, rods_x86_64_v3});
  if (__builtin_cpu_supports("x86-64-v4")) out.push_back({cloth_x86_64_v4, rods_x86_64_v4});
#endif
  return out;
}

std::vector<std::string> kernel_names() {
  std::vector<std::string> names;
  for (const KernelLevel& level : kernel_levels()) names.push_back(level.cloth.name);
  return names;
}

KernelLevel kernel_level(const std::string& name) {
  const std::vector<KernelLevel> all = kernel_levels();
  if (name.empty()) return all.back();
  std::string known;
  for (const KernelLevel& level : all) {
    if (level.cloth.name == name) return level;
    known += (known.empty() ? "" : ", ") + std::string(level.cloth.name);
  }
  refuse(text("kernel: must be one that this processor runs, ", known, ", got '", name, "'"));
}

}  // namespace sim_core
