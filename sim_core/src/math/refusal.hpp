// How the core refuses what it is given: std::invalid_argument, which Python sees as ValueError.
#pragma once

#include <sstream>
#include <stdexcept>
#include <string>

namespace sim_core {

[[noreturn]] inline void refuse(const std::string& message) {
  throw std::invalid_argument(message);
}

template <class... Parts>
std::string text(const Parts&... parts) {
  std::ostringstream out;
  (out << ... << parts);
  return out.str();
}

}  // namespace sim_core
