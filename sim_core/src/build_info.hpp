// What this library was built from.
#pragma once

#include <string>

namespace sim_core {

struct BuildInfo {
  std::string version;
  std::string build_hash;    // SHA-256, hex: sources, compiler, flags and instruction set; see cmake/build_hash.cmake
  std::string compiler;      // id and version
  std::string isa;           // instruction set of the whole library
  std::string rod_kernel;    // the rod solver's vectors on this processor; its bits are the same for all
  std::string cloth_kernel;  // level of the cloth kernels, whose last digits differ from level to level
  std::string eigen;         // version
};

BuildInfo build_info();

}  // namespace sim_core
