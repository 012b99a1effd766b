// Coulomb's law with unilateral contact, exactly: no force at a distance, no sinking in, friction
// on its cone against the slip. It is the same for a node on a body or on a smooth surface, and for
// two pieces of cloth.
//
// Let r be the force that a contact bears [N], r_N its part along the normal n and r_T the rest, g
// the gap [m], u the slip in this step [m], and k > 0 a stiffness [N/m] that decides how fast the
// search goes, not where it ends. With z = r - k (g n + u), the law is the root of r = P(z)
// [Alart & Curnier 1991, Eqs. 10-12]:
//
//     P_N = max(0, z_N)
//     P_T = projection of z_T on the disc of radius mu (r_N + q)
//
// so that a contact is open (r = 0), sticks (g = 0, u = 0) or slips (g = 0, r_T = mu (r_N + q) t,
// t = z_T/|z_T|). The force q is that of a body on the other side, or 0. Where Newton's method does
// not find which contacts bear and which slip, the law is smoothed over an energy epsilon, as by
// the logarithms of the slack in r_N >= 0 and in |r_T| <= mu r_N: r_N g = epsilon and u = -2
// epsilon r_T/((mu r_N)^2 - |r_T|^2). In the form above, which holds whatever sign g has [Chen &
// Harker 1993; Kanzow 1996],
//
//     P_N = (z_N + sqrt(z_N^2 + 4 k epsilon))/2
//     P_T = rho t,  rho + 2 k epsilon rho/((mu P_N)^2 - rho^2) = |z_T|
//
// and it is the exact law in the limit of no epsilon.
//
// Newton's method needs four numbers of either, and the direction t:
//
//     dP = a n (dr_N - k dg) + [b_t t t^T + b_s (1 - n n^T - t t^T)] (dr_T - k du) + c t dr_N
//
//              a    b_t    b_s                   c
//     open     0    0      0                     0
//     stick    1    1      1                     0
//     slip     1    0      mu (r_N + q)/|z_T|    mu
//
// The smoothed law has values between these. From here mu, the coefficient of friction, enters the
// matrix by two ways, both in linearized_contact.cpp: c couples friction to the normal force
// (`NodeRow::coupling`, `PairRow::stiffness` and `PairRow::force_by_normal`), and b_s is a
// stiffness against a turn of friction (`NodeRow::turn_stiffness` and `PairRow::symmetric`). The
// product of the matrix with a vector has both (`apply_contact` and `add_pairs` in
// cloth/kernels/krylov.hpp). Only the second is symmetric, so it also enters what is factorised:
// `ContactState::factor_block` in state.cpp for nodes, `PairRow::symmetric` in
// cloth/pair_factor.cpp for pairs.
#pragma once

#include <Eigen/Core>

#include "contact/rows.hpp"

namespace sim_core {

// One contact at an iterate. Normal and slip are those of the first side over the second, and the
// force is that on the first.
struct Contact {
  double gap;              // g, m
  Eigen::Vector3d normal;  // n, unit
  Eigen::Vector3d slip;    // u, m: since the start of the step, in the tangent plane
  Eigen::Vector3d force;   // r, N
  double mu;               // coefficient of friction; of a node on a round body as corrected
                           // for the size of the cell (`ContactState::mu_at`)
  double stiffness;        // k, N/m
  double pressed = 0.0;    // q, N: by what presses from the other side, where friction acts, too

  double normal_force() const { return force.dot(normal); }
  Eigen::Vector3d friction() const { return force - normal_force() * normal; }
};

// Derivatives of the law, see above.
struct LawDerivative {
  double normal = 0.0;    // a
  double along = 0.0;     // b_t
  double across = 0.0;    // b_s
  double coupling = 0.0;  // c: of friction to the normal force
};

// The force P that the law asks of a contact, and its derivatives.
struct LawResponse {
  ContactMode mode = contact_open;
  Eigen::Vector3d direction = Eigen::Vector3d::Zero();  // t
  double normal_force = 0.0;                            // P_N, N
  Eigen::Vector3d friction = Eigen::Vector3d::Zero();   // P_T, N
  double bearing_force = 0.0;  // N: of both sides; the bound of friction is mu times this
  LawDerivative derivative;
};

// The exact law, on the branch that holds at the iterate. A contact that sinks in is about to bear
// more than r_N, so it sticks up to mu z_N.
LawResponse coulomb_law(const Contact& contact);

// The law that is smoothed over `epsilon` > 0, J.
LawResponse smoothed_law(const Contact& contact, double epsilon);

// Branches that are chosen, whatever the law says at the iterate.
LawResponse sticking(const Contact& contact);
LawResponse slipping(const Contact& contact);
// Slips along `direction`; friction turns against `turn_stiffness`, N/m.
LawResponse slipping_along(const Contact& contact, const Eigen::Vector3d& direction,
                           double turn_stiffness);

// The branch of an open contact that `motion` [m] closes: it sticks if it slips by no more than mu
// times the length by which it would sink in, else it slips.
LawResponse closing(const Contact& contact, const Eigen::Vector3d& motion);

// Square of the force by which the law is missed, N^2; `epsilon`: 0 for the exact law, J.
double missed_squared(const Contact& contact, double epsilon = 0.0);
// The same where the response is known.
double missed_squared(const Contact& contact, const LawResponse& law);

}  // namespace sim_core
