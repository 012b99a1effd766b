#include "cloth/kernels/choice.hpp"

#include "cloth/refusal.hpp"

namespace sim_core {
namespace {

std::vector<ClothKernel> runnable() {
  std::vector<ClothKernel> out{cloth_baseline};
#ifdef SIM_CORE_X86_64_KERNELS
  __builtin_cpu_init();
  if (__builtin_cpu_supports("x86-64-v3")) out.push_back(cloth_x86_64_v3);
  if (__builtin_cpu_supports("x86-64-v4")) out.push_back(cloth_x86_64_v4);
#endif
  return out;
}

}  // namespace

ClothKernel cloth_kernel_named(const std::string& name) {
  const std::vector<ClothKernel> all = runnable();
  if (name.empty()) return all.back();
  for (const ClothKernel& kernel : all) {
    if (kernel.name == name) return kernel;
  }
  std::string known;
  for (const ClothKernel& kernel : all) known += (known.empty() ? "" : ", ") + std::string(kernel.name);
  refuse(text("kernel: must be one that this processor runs, ", known, ", got '", name, "'"));
}

std::vector<std::string> cloth_kernels() {
  std::vector<std::string> names;
  for (const ClothKernel& kernel : runnable()) names.push_back(kernel.name);
  return names;
}

}  // namespace sim_core
