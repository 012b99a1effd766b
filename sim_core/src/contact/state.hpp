// Contacts of the nodes with bodies and smooth surfaces: modes, rows of Newton's system, and what
// is kept from step to step.
#pragma once

#include <Eigen/Core>
#include <array>
#include <limits>
#include <memory>
#include <optional>
#include <vector>

#include "contact/bodies.hpp"
#include "contact/capstan.hpp"
#include "contact/closest.hpp"
#include "contact/friction_cones.hpp"
#include "contact/linearized_contact.hpp"
#include "contact/pn_triangles.hpp"
#include "contact/rows.hpp"
#include "contact/surface.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// What a node sees of a smooth surface.
struct SmoothTouch {
  double gap;              // m
  Eigen::Vector3d normal;  // towards the cloth
  int surface;
};

// Contacts of the cloth's nodes with the smooth surfaces through the vertices of prescribed
// triangles.
//
// A node keeps half of both thicknesses away from the surface and touches it as it touches a body,
// by one normal and one gap. Where the surface is so curved that the triangles between nodes would
// cut into it, nodes keep further away: a triangle in a circle of radius r sinks by r^2 kappa/2
// below its corners on a surface of curvature kappa. A node stays on the side of the triangles on
// which it is when a step begins. What nodes do not catch, triangles that poke through between
// them, is left to pairs of closest points.
class SmoothContact {
 public:
  // `triangles`: nodes; `sheet_of_node`: of cloth, and after them surfaces. `crease`: of each
  // surface, see CreasedTriangles. x: where the surfaces are. `radius`: of the circle around the
  // largest triangle at each free node, m.
  SmoothContact(std::vector<std::array<int, 3>> triangles, std::vector<int> sheet_of_node,
                const ContactMaterials& materials, const std::vector<double>& crease,
                const Buffer<double>& x, const std::vector<double>& radius);

  // Forgets which triangles are touched.
  void restart();
  // An attempt at a step begins at `start`; it takes the surfaces to `ends`, and the cloth to about
  // `guess`. Pairs alone keep from surfaces what begins near a body, and go on until it is out of
  // them: put out at once, it would tear at the cloth around it.
  void begin(const Buffer<double>& start, const Buffer<double>& ends, const Buffer<double>& guess,
             const std::vector<Body>& at_start);
  // A step ended, with these nodes in contact.
  void store_history(const std::vector<int>& mode);

  // What a node sees at p, if a surface is near.
  std::optional<SmoothTouch> touch(int node, const Eigen::Vector3d& p);
  // How far a node that was at `before` when the step began was too near then, if by more than
  // `allowed`, m.
  Eigen::Vector3d depenetration(int node, const Eigen::Vector3d& before, double allowed) const;
  // Of what the node saw last: its way over the surface since it was at `before` when the step
  // began, m; friction; and the projection.
  Eigen::Vector3d slip(int node, const Eigen::Vector3d& before, const Eigen::Vector3d& p) const;
  double mu(int node, Cone cone) const;
  bool has_static() const { return materials_.has_static(); }
  // By which the surface turned in the step where the node saw it last.
  Eigen::Matrix3d turn(int node) const;
  // The normal at p, which is near what the node saw last: that one where there is no projection.
  Eigen::Vector3d normal_near(int node, const Eigen::Vector3d& p) const;
  // What the node sees at p, which is near what it saw last. It remembers nothing of it.
  std::optional<SmoothTouch> touch_near(int node, const Eigen::Vector3d& p) const;
  const Projection& projection(int node) const { return projections_[node]; }
  const std::vector<std::array<int, 3>>& triangles() const { return patches_.triangles(); }

 private:
  void take_shapes(const Buffer<double>& start, const Buffer<double>& ends);
  int surface_of(int triangle) const { return sheet_of_node_[patches_.triangles()[triangle][0]]; }

  double rest_distance(const PatchShape& shape, int node, const Projection& projection) const;

  std::vector<int> sheet_of_node_;
  std::vector<double> radius_;
  int free_nodes_;
  int first_ = std::numeric_limits<int>::max();  // of the surfaces' nodes, which are the last
  ContactMaterials materials_;
  PNTriangles patches_;
  TriangleTree tree_;
  PatchShape start_, end_;
  struct TouchedTriangles {
    std::vector<int> triangle;  // (free nodes): -1: none is near; -2: left to pairs
    std::vector<double> side;
  };
  TouchedTriangles touched_, history_;
  std::vector<Projection> projections_;
};

// How far an iterate is from the solution: the largest force that a node lacks [N], and the sum of
// their squares.
struct ForceNorms {
  double largest = 0.0, squared = 0.0;
  void count(double force_squared);
};

// Pressure that would close cloth between two bodies to nothing, Pa. Fabrics lose a quarter to a
// third of their thickness at 5 kPa in the compression test of [Kawabata 1980].
constexpr double compression = 2e4;

// What a node sees of the bodies: the nearest, or, in a corner, the fillet between two or three.
//
// Cloth has a thickness h where it lies between two bodies that face each other. The opposite one,
// at a distance d from the face of the nearest, presses on it by `compression` (1 - d/h).
struct BodyContact {
  Gap gap;
  int body = -1;                          // -1: none
  std::array<int, 2> neighbours{-1, -1};  // the same
  std::array<double, 2> weights{};        // of the neighbours in what bears
  int opposite = -1;                      // -1: none
  Gap across{std::numeric_limits<double>::infinity(), Eigen::Vector3d::Zero()};  // of the opposite

  template <class Of>
  auto mean(const Of& of) const {
    const auto of_body = of(body);
    auto out = of_body;
    for (int k = 0; k < 2 && neighbours[k] >= 0; ++k)
      out += weights[k] * (of(neighbours[k]) - of_body);
    return out;
  }

  // The same, or of both sides where there is an opposite body.
  template <class Of>
  auto average(const Of& of) const {
    auto out = mean(of);
    if (opposite >= 0) out = 0.5 * (of(body) + of(opposite));
    return out;
  }
};

class ContactState {
 public:
  explicit ContactState(int free_nodes);

  std::vector<int> mode,
      touched;  // (free nodes): ContactMode, and the body, or after them the surface (-1: none)
  std::vector<int> sheet;         // (free nodes): to which they belong
  std::vector<double> cell;       // (free nodes): side of a cell, m
  std::vector<double> thickness;  // (free nodes): of the cloth, m
  std::vector<double> area;       // (free nodes): of the cloth, m^2
  std::vector<double> stiffness;  // (free nodes): k of the law, N/m
  Buffer<float> normal, direction, coupling, turn_stiffness;
  Buffer<float> force,
      correction;  // (free nodes, 4): the right-hand side, N, and what contact prescribes, m

  std::vector<Cone> cone;  // (free nodes): of friction with what they touch

  std::unique_ptr<SmoothContact> surfaces;  // null if there are none

  // Whether nodes whose friction turns back from one iterate to the next stick in the linear
  // problem. Newton's method may else go to and fro between the two ways of slipping, where the law
  // has it that they stick.
  bool stick_on_reversal = false;

  BodyContact body_contact(const std::vector<Body>& bodies, const Eigen::Vector3d& p) const;
  // The same of a node of cloth with a thickness: with the body on its other side, if any is near.
  BodyContact body_contact(const std::vector<Body>& bodies, const Eigen::Vector3d& p,
                           int node) const;
  // Force of the opposite body on a node, without friction, N.
  Eigen::Vector3d press(const BodyContact& on, int node) const;
  // Way over the bodies of a node that was at `before` when the step began, in the plane of
  // contact, m.
  static Eigen::Vector3d slip(const BodyContact& on, const Eigen::Vector3d& before,
                              const Eigen::Vector3d& p, const std::vector<Body>& at_start,
                              const std::vector<Body>& at_end);

  // Begins an attempt at a step that velocities are `expected` to lead there.
  void begin(const Buffer<double>& expected, const std::vector<Body>& at_end);
  // Classifies the contacts of the free nodes at `x`, which were at `start` when the step began and
  // need `residual` from contact.
  ForceNorms classify_contacts(const Buffer<double>& x, const Buffer<double>& start,
                               const Buffer<double>& residual, const std::vector<Body>& at_start,
                               const std::vector<Body>& at_end);

  // Puts the nodes that were in contact at the end of the last step back into the mode and
  // direction they had, for the first linear problem of a step of dt: at a predicted state the law
  // would sort many of them wrongly.
  bool warm_start(const Buffer<double>& x, const Buffer<double>& start,
                  const Buffer<double>& residual, const std::vector<Body>& at_start,
                  const std::vector<Body>& at_end, double dt);
  // After a step was solved: gives contacts the cones that hold now. Returns whether any changed.
  bool switch_cones();
  // Keeps the modes, directions and stiffnesses of a step that ended, for the next; or none.
  void store_history(double dt);
  void clear_history();
  // Forgets what slid, too: another state is set.
  void restart();

  ContactRows rows() const;

  // The contact of a node at x, which was at `start` when the step began.
  Contact contact_at(int node, const BodyContact& on, const Buffer<double>& x,
                     const Buffer<double>& start, const Buffer<double>& residual,
                     const std::vector<Body>& at_start, const std::vector<Body>& at_end) const;
  // Coefficient of friction of a node at p, whose friction points along `friction`, of any length;
  // see capstan.hpp.
  FrictionCoefficient mu_at(int node, const BodyContact& on, const Eigen::Vector3d& p,
                            const Eigen::Vector3d& friction, const std::vector<Body>& at_end) const;

  // What contact adds to the block of a node in the matrix that is factorised: xx xy xz yy yz zz,
  // N/m. k n n^T where it slips, and the stiffness against a turn of friction, which mu sets; k in
  // all directions where it sticks; k by the node's own stiffness.
  void factor_block(int node, double own_stiffness, float* out) const;

 private:
  void write(int node, const NodeRow& row);
  // Sets the cone of a node on a body that it did not touch at the iterate before.
  void choose_cone(int node, const BodyContact& on, const Buffer<double>& x,
                   const Buffer<double>& start, const std::vector<Body>& at_start,
                   const std::vector<Body>& at_end);
  bool has_static(int node, const BodyContact& on, const std::vector<Body>& at_end) const;
  // Slip between two places of a node, in the plane of contact, m.
  Eigen::Vector3d slip_to(int node, const BodyContact& on, const Eigen::Vector3d& before,
                          const Eigen::Vector3d& p, const std::vector<Body>& at_start,
                          const std::vector<Body>& at_end) const;

  struct History {
    std::vector<int> mode, touched;
    Buffer<float> direction, turn_stiffness;
    double dt = 0.0;  // 0: nothing is kept
  };
  History history_;

  // Of static friction, where any body or surface has it.
  struct Resting {
    bool applies = false;
    const Buffer<double>* expected = nullptr;
    // (free nodes): where the last step ended, as `mode` and `touched`.
    std::vector<int> mode, touched;
    std::vector<int> of;         // (free nodes): the body for which the cone stands; -1: none
    std::vector<double> onward;  // (free nodes): slip times the way by velocities, m^2
  };
  Resting resting_;
};

}  // namespace sim_core
