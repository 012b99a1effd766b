// How far a solve of Newton's method has come.
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

namespace sim_core {

// The largest of the last residuals: a step may raise the residual, but not above this [Grippo et
// al. 1986].
class NonMonotoneLimit {
 public:
  NonMonotoneLimit(int length, double residual) : window_(length, residual) {}
  double value() const { return *std::max_element(window_.begin(), window_.end()); }
  void restart(double residual) { std::fill(window_.begin(), window_.end(), residual); }
  void add(int iteration, double residual) { window_[iteration % window_.size()] = residual; }

 private:
  std::vector<double> window_;
};

// The least residual so far, and when it last halved. Residuals are squares of forces, N^2.
struct Progress {
  explicit Progress(double residual) : first(residual), least(residual), halved(residual) {}

  // The law has become sharper: earlier residuals do not compare.
  void restart() { least = halved = std::numeric_limits<double>::infinity(); }
  void note_halving(int iteration) {
    if (least < 0.5 * halved) halved = least, halved_at = iteration;
  }

  double first, least, halved;
  int halved_at = 0;
};

}  // namespace sim_core
