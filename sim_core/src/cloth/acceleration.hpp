// Acceleration of a linear iteration z <- z + f(z): the next z is the best mix of those before
// [Anderson 1965; Walker & Ni 2011, Algorithm AA]. For a linear f that is GMRES, which converges
// where the plain iteration does not.
#pragma once

#include <Eigen/Dense>
#include <algorithm>

namespace sim_core {

class Acceleration {
 public:
  void restart() { count_ = 0; }

  // Takes f(z) at z, and returns the next z.
  Eigen::VectorXd next(const Eigen::VectorXd& z, const Eigen::VectorXd& f) {
    Eigen::VectorXd out = z + f;
    if (count_ > 0) {
      const int column = (count_ - 1) % depth;
      if (count_ == 1) {
        z_changes_.resize(z.size(), depth);
        f_changes_.resize(z.size(), depth);
      }
      z_changes_.col(column) = z - z_before_;
      f_changes_.col(column) = f - f_before_;
      const int columns = std::min(count_, depth);
      const auto changes = f_changes_.leftCols(columns);
      const Eigen::VectorXd shares = changes.colPivHouseholderQr().solve(f);
      out -= (z_changes_.leftCols(columns) + changes) * shares;
    }
    ++count_;
    z_before_ = z;
    f_before_ = f;
    return out;
  }

 private:
  // Iterates that are mixed: more of them cost memory, and rarely save a round.
  static constexpr int depth = 10;

  int count_ = 0;
  Eigen::VectorXd z_before_, f_before_;
  Eigen::MatrixXd z_changes_, f_changes_;
};

}  // namespace sim_core
