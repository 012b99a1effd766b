// Coulomb's law at one contact, exactly: no force at a distance, no sinking in, friction on its
// cone against the slip.
//
// Let r be the force that the contact bears [N], r_N its part along the normal n and r_T the rest,
// g the gap [m], u the slip in this step [m], and k > 0 a stiffness [N/m] that decides how fast the
// search goes, not where it ends. The law is a root of functions that are smooth but for kinks
// [Alart & Curnier 1991, Eqs. 10-12]:
//
//     r_N = max(0, r_N - k g)
//     r_T = projection of tau on the disc of radius mu r_N,  tau = r_T - k u
//
// so that a contact is open (r = 0), sticks (g = 0, u = 0) or slips (g = 0, r_T = mu r_N t, t =
// tau/|tau|). Newton's method takes the derivative of the branch at hand. With b = mu r_N it reads,
// where a contact slips,
//
//     along t:   dr_T - mu dr_N                 = -(r_T . t - b)
//     across it: dr_T + (b/(|tau| - b)) k du_T  = -(|tau|/(|tau| - b)) r_across
//
// The second line is friction that turns with the slip; its stiffness is `turning`. Without it
// friction would keep its direction for the whole step.
//
// Between two pieces of cloth, at one pair of closest points, the same law holds with the gap g =
// |rho| - thickness. The pair's force r is an unknown of its own: it acts with w_i r on the nodes
// of the pair (contact/closest.hpp). Newton's method takes the derivative of the branch at hand,
// with a proximal term [Rockafellar 1976], by which pairs that say the same do no harm: g + dg +
// dr_N/kappa = 0 along the normal, u + du + dr_T/lambda = 0 across it. It vanishes as the iteration
// converges. With the pair's motion v = sum w_i dx_i the row is dr = force - stiffness v:
//
//     open :  stiffness 0                       force -r
//     stick:  kappa n n^T + lambda (1 - n n^T)  -kappa g n - lambda u
//     slip :  kappa (n + mu t) n^T + s P        -kappa g n + (mu r_N - t . r_T - mu kappa g) t - (s
//     / (beta k)) P r_T
//
// with t = tau/|tau|, beta = mu r_N/|tau|, P = 1 - n n^T - t t^T and s = min(lambda, beta k/(1 -
// beta)), by which friction turns with the slip.
//
// Where this does not find which pairs bear and which slip, the law is smoothed over an energy
// epsilon, as by the logarithms of the slack in r_N >= 0 and to |r_T| <= mu r_N: r_N g = epsilon
// and u = -2 epsilon r_T/((mu r_N)^2 - |r_T|^2). In the form above, which holds whatever sign g has
// [Chen & Harker 1993; Kanzow 1996],
//
//     r_N = R_N = (z + sqrt(z^2 + 4 k epsilon))/2,  z = r_N - k g,
//     r_T = rho t,  rho + 2 k epsilon rho/((mu R_N)^2 - rho^2) = |tau|,
//
// and it is the exact law in the limit of no epsilon.
//
// As the normal turns, friction turns with it: dr = turning dn, to which sticking pairs, whose
// force is what holds them, add nothing.
#pragma once

#include <Eigen/Core>

namespace sim_core {

// State of a contact at an iterate.
struct ContactKinematics {
  double gap;              // m
  Eigen::Vector3d normal;  // of the body, outward
  Eigen::Vector3d
      slip;  // m: of the cloth over the body since the start of the step, in the tangent plane
  Eigen::Vector3d force;  // N: that the node needs from the contact
  double mu;
  double stiffness;  // k, N/m
};

// The branch that holds there, and its row of Newton's system. `force` is the right-hand side in
// the directions that are free, `correction` the displacement in those that are not.
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
ContactLinearization slipping_row(const ContactKinematics& at, const Eigen::Vector3d& direction,
                                  double turning);

// State of a pair at an iterate: the normal is from the second to the first, the slip that of the
// first over the second, and the force that on the first.
struct PairKinematics : ContactKinematics {
  double along, across;    // kappa and lambda: proximal, along the normal and across it, N/m
  double smoothing = 0.0;  // epsilon, J
};

// Its row of Newton's system: dr = force - stiffness v + turning dn.
struct PairLinearization {
  int mode = 0;                                         // ContactMode
  Eigen::Matrix3d stiffness = Eigen::Matrix3d::Zero();  // N/m
  Eigen::Matrix3d symmetric =
      Eigen::Matrix3d::Zero();  // its part for the factor: without mu kappa t n^T
  Eigen::Vector3d force = Eigen::Vector3d::Zero();    // N
  Eigen::Matrix3d turning = Eigen::Matrix3d::Zero();  // N: by the normal's change
};

// The branch that holds there. A pair that sinks in is about to bear more than r_N: it sticks up to
// mu (r_N - k g).
PairLinearization linearize(const PairKinematics& at);
// The branch of a pair that `motion` closes, whatever its gap and force are now: it sticks if it
// slips by no more than mu times what it would sink in, and it slips else.
PairLinearization linearize_closing(const PairKinematics& at, const Eigen::Vector3d& motion);
// Square of the force by which the law is missed, N^2.
double pair_error_squared(const PairKinematics& at);

}  // namespace sim_core
