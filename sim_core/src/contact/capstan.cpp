#include "contact/capstan.hpp"

#include <algorithm>
#include <cmath>

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Half the angle by which cloth turns at a node, on one side of it: that of the tangent with the
// chord to the next node. With a cell h and a radius R the normal over h/2 of the tangent leans by
// b, tan b = h/(2 R), and the chord by a/2, sin(a/2) = h/(2 R).
double lean_of_chord(const Vector3d& here, const Vector3d& away, const Vector3d& direction) {
  // A radius of 0.56 cells: no scene is run with less.
  constexpr double sine_max = 0.9;
  const double up = here.dot(away);
  const double side = direction.dot(away);
  const double sine = up > 0.0 ? side / up : std::copysign(sine_max, side);
  return std::asin(std::clamp(sine, -sine_max, sine_max));
}

}  // namespace

FrictionCoefficient mu_between_cells(double mu, const NormalsOfCell& normals,
                                     const Vector3d& along) {
  // On flat faces nothing leans but by rounding, and mu stays as it is, bit by bit.
  constexpr double flat = 1e-5;  // rad
  const double half_turn = 0.5 * std::abs(lean_of_chord(normals.here, normals.ahead, along) +
                                          lean_of_chord(normals.here, normals.behind, -along));
  if (!(half_turn > flat)) return {mu};
  const double bounded = std::tanh(mu * half_turn);
  const double slope = std::tan(half_turn);
  return {bounded / slope, half_turn * (1.0 - bounded * bounded) / slope};
}

}  // namespace sim_core
