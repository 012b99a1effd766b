// What contacts of nodes and of pairs share in the sensitivities.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <limits>

#include "cloth/sensitivities.hpp"

namespace sim_core {

constexpr double infinite = std::numeric_limits<double>::infinity();
// Stiffness against a turn of friction over that of the law, from which a contact is as good as
// stuck.
constexpr double turn_stiffness_max = 1e4;

// The change of a parameter that takes `margin` to 0, to first order.
inline double event_at(double margin, double rate) {
  return rate != 0.0 ? std::abs(margin / rate) : infinite;
}

inline double largest_of(const Buffer<double>& vectors) {
  double out = 0.0;
  for (double component : vectors) out = std::max(out, std::abs(component));
  return out;
}

inline Eigen::Vector3d in_plane(const Eigen::Vector3d& vector, const Eigen::Vector3d& normal) {
  return vector - vector.dot(normal) * normal;
}

// b_s k/(1 - b_s) of a contact that slides by `length` [m], whose friction is `bound` [N] and whose
// law has the stiffness k [N/m]: the stiffness against a turn of friction, N/m.
inline double turn_stiffness_of(double bound, double length, double stiffness) {
  const double most = turn_stiffness_max * stiffness;
  if (!(bound > 0.0)) return 0.0;
  return length > 0.0 ? std::min(bound / length, most) : most;
}

}  // namespace sim_core
