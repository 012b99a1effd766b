// CPU time of this thread.
#pragma once

#include <ctime>

namespace sim_core {

inline double cpu_seconds() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

// Adds the CPU seconds of its life to a total.
struct Stopwatch {
  double& total;
  double start = cpu_seconds();
  explicit Stopwatch(double& total_in) : total(total_in) {}
  Stopwatch(const Stopwatch&) = delete;
  ~Stopwatch() { total += cpu_seconds() - start; }
};

}  // namespace sim_core
