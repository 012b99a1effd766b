// Coulomb's law at one contact, exactly: no force at a distance, no sinking in, friction on its cone against the slip.
//
// Let r be the force that the contact bears [N], r_N its part along the normal n and r_T the rest, g the gap [m], u the
// slip in this step [m], and k > 0 a stiffness [N/m] that decides how fast the search goes, not where it ends. The law
// is a root of functions that are smooth but for kinks [Alart & Curnier 1991, Eqs. 10-12]:
//
//     r_N = max(0, r_N - k g)
//     r_T = projection of tau on the disc of radius mu r_N,  tau = r_T - k u
//
// so that a contact is open (r = 0), sticks (g = 0, u = 0) or slips (g = 0, r_T = mu r_N t, t = tau/|tau|). Newton's
// method takes the derivative of the branch at hand. With b = mu r_N it reads, where a contact slips,
//
//     along t:   dr_T - mu dr_N                 = -(r_T . t - b)
//     across it: dr_T + (b/(|tau| - b)) k du_T  = -(|tau|/(|tau| - b)) r_across
//
// The second line is friction that turns with the slip; its stiffness is `turning`. Without it friction would keep its
// direction for the whole step.
#pragma once

#include <Eigen/Core>

namespace sim_core {

// State of a contact at an iterate.
struct ContactKinematics {
  double gap;              // m
  Eigen::Vector3d normal;  // of the body, outward
  Eigen::Vector3d slip;    // m: of the cloth over the body since the start of the step, in the tangent plane
  Eigen::Vector3d force;   // N: that the node needs from the contact
  double mu;
  double stiffness;  // k, N/m
};

// The branch that holds there, and its row of Newton's system. `force` is the right-hand side in the directions that
// are free, `correction` the displacement in those that are not.
struct ContactLinearization {
  int mode;                    // ContactMode
  Eigen::Vector3d direction;   // t
  Eigen::Vector3d force;       // N
  Eigen::Vector3d correction;  // m
  double coupling;             // mu where the normal force is positive, else 0
  double turning;              // N/m
  double error_squared;        // N^2: by how far the law is missed
};

ContactLinearization open_row(const Eigen::Vector3d& force);
// `turning_max`: bound of `turning` over the stiffness k, from which a contact is as good as stuck.
ContactLinearization closed_row(const ContactKinematics& at, double turning_max);

// The rows of a branch that is chosen, whatever the law says at the iterate.
ContactLinearization sticking_row(const ContactKinematics& at);
ContactLinearization slipping_row(const ContactKinematics& at, const Eigen::Vector3d& direction, double turning);

}  // namespace sim_core
