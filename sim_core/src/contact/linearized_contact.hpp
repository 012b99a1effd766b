// How a contact enters the linear system of Newton's method: a contact of a node with a body or a
// smooth surface (`NodeRow`), and a contact of a pair of closest points (`PairRow`). Both read the
// four derivatives of the law (coulomb_law.hpp) and differ in what becomes of the contact's force.
//
// The linearized law r + dr = P + dP reads, in each direction d with derivative b,
//
//     (1 - b) dr_d + b k v_d = P_d - r_d,    v the motion of the contact, m
//
// and along t, in addition, mu times the change of the normal force. The bound of friction is taken
// at the new normal force, mu (r_N + dr_N). That is also right where the force still pulls, r_N <
// 0, but the contact sinks in: at the end of the iteration it pushes, and friction is on its cone.
// The cone is straight, so its linearization is exact for whatever r_N + dr_N the linear problem
// finds.
//
// A node on a body needs no unknown: the force is the residual of its own equations. Where b = 1,
// the motion is prescribed, k v_d = P_d - r_d. The other directions keep their equations, with the
// stiffness b k/(1 - b) (`NodeRow`).
//
// The force of a pair is an unknown of its own, with a proximal term [Rockafellar 1976] by which
// pairs that say the same do no harm: it adds b k/kappa dr_d, and vanishes as the iteration
// converges. Then dr = force - stiffness v + force_by_normal dn (`PairRow`), with
// s = (1 - b)/k + b/kappa and dr_d = -(b/s) v_d + (P_d - r_d)/(k s).
#pragma once

#include <Eigen/Core>

#include "contact/coulomb_law.hpp"

namespace sim_core {

// A node's equations under contact: `force` is the right-hand side in the directions that are free,
// `correction` the displacement in the directions that contact prescribes.
struct NodeRow {
  ContactMode mode = contact_open;
  Eigen::Vector3d direction = Eigen::Vector3d::Zero();   // t
  Eigen::Vector3d force = Eigen::Vector3d::Zero();       // N
  Eigen::Vector3d correction = Eigen::Vector3d::Zero();  // m
  double coupling = 0.0;                                 // c
  double turn_stiffness = 0.0;                           // N/m: against a turn of friction
};

// `turn_stiffness_max`: bound of `turn_stiffness` over the stiffness k, from which a contact is as
// good as stuck.
NodeRow node_row(const Contact& contact, const LawResponse& law, double turn_stiffness_max);

// Proximal stiffness of a pair, N/m.
struct ProximalStiffness {
  double normal;      // kappa
  double tangential;  // lambda
};

// dr = force - stiffness v + force_by_normal dn.
struct PairRow {
  ContactMode mode = contact_open;
  Eigen::Matrix3d stiffness = Eigen::Matrix3d::Zero();  // N/m
  Eigen::Matrix3d symmetric = Eigen::Matrix3d::Zero();  // N/m: without the coupling, for factors
  Eigen::Vector3d force = Eigen::Vector3d::Zero();      // N
  Eigen::Matrix3d force_by_normal = Eigen::Matrix3d::Zero();  // N: friction turns with the normal
};

PairRow pair_row(const Contact& contact, const LawResponse& law, const ProximalStiffness& proximal);

}  // namespace sim_core
