// Static and kinetic friction: which of two cones bounds the friction of a contact.
//
// A contact holds with up to mu_s R_N, and slides with mu_k R_N, mu_k <= mu_s. Coulomb's law
// (coulomb_law.hpp) has one coefficient. Here stands which of the two it is given:
//
//   cone      coefficient  a contact that begins the step        once the step is solved
//   resting   mu_s         stuck, or without motion along it     released where it slips
//   sliding   mu_k         sliding                               resting where it slips back: on
//                                                                the way it came to rest
//   released  mu_k                                               keeps this cone
//
// The step is solved again with the cones that changed, until none does. A contact changes its cone
// twice at most, so that ends. What slips at the end of a step slips by mu_k, and mu_s only decides
// what holds. Where both coefficients are equal nothing of this happens.
#pragma once

#include <Eigen/Core>

#include "contact/rows.hpp"

namespace sim_core {

enum class Cone : char { sliding, resting, released };

// Way along a contact in a step, in m, below which its two sides rest on each other: the slip that
// a solved step may leave where it sticks.
constexpr double resting_way = 1e-8;

// The cone of a contact with this mode at the end of the step before.
inline Cone cone_after(int mode) { return mode == contact_stick ? Cone::resting : Cone::sliding; }

// The same of one that was open: `way` by which velocities carry its sides along each other, m.
inline Cone cone_of_new(const Eigen::Vector3d& way) {
  return way.norm() <= resting_way ? Cone::resting : Cone::sliding;
}

// The cone after a step was solved in which the contact ended with `mode`. `onward`: its slip times
// the way along which velocities carried it, m^2.
inline Cone next_cone(Cone cone, int mode, double onward) {
  if (mode != contact_slip) return cone;
  if (cone == Cone::resting) return Cone::released;
  return cone == Cone::sliding && onward < 0.0 ? Cone::resting : cone;
}

}  // namespace sim_core
