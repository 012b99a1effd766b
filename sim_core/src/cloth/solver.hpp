// Dynamics of cloth in contact with moving bodies, itself and moving surfaces: staggered steps,
// exact Coulomb friction.
#pragma once

#include <Eigen/Core>
#include <cstdint>
#include <memory>
#include <string>
#include <tuple>
#include <vector>

#include "cloth/control.hpp"
#include "cloth/mesh.hpp"
#include "cloth/numbering.hpp"
#include "cloth/settings.hpp"
#include "contact/bodies.hpp"
#include "contact/contact_set.hpp"
#include "contact/state.hpp"
#include "contact/surface.hpp"

namespace sim_core {

// Triangles that are no cloth, the surface that each of their vertices belongs to, the initial
// positions of these, and the angle from which edges of each surface are sharp, rad.
struct SurfaceMeshes {
  Triangles triangles;
  std::vector<std::int32_t> surface_of_vertex;
  Points3 positions;
  std::vector<double> crease;
};

// Contact of a cloth with itself, its sheets and surfaces, set up from meshes (contact_setup.cpp).
//
// Side of a cell of the coarsest sheet, m.
double cell_of(const ClothMesh& mesh);
// Side of a cell around each vertex, m: that of a square of two of its triangles.
std::vector<double> cells_of_vertices(const ClothMesh& mesh);
// Area of the cloth that belongs to each vertex, m^2.
std::vector<double> areas_of_vertices(const ClothMesh& mesh);

// Throws std::invalid_argument, naming the field, where the cloth would touch itself at rest.
std::unique_ptr<ContactSet> contact_set_of(const ClothMesh& mesh, const Numbering& numbering,
                                           const ContactMaterials& materials,
                                           const SurfaceMeshes& surfaces);
std::unique_ptr<SmoothContact> smooth_contact_of(const ClothMesh& mesh, const Numbering& numbering,
                                                 const ContactMaterials& materials,
                                                 const SurfaceMeshes& surfaces);

// What a solver is made of.
struct ClothSetup {
  Points2 rest;
  Triangles triangles;
  std::vector<ClothProperties> fabrics;  // one, or one of each sheet
  std::vector<std::int32_t> held;        // vertices whose positions are prescribed
  ClothSettings settings;
  StepControl control;
  std::string kernel;      // level of the kernels, "" for the widest that this processor runs
  ContactMaterials touch;  // among the sheets and then the surfaces
  SurfaceMeshes surfaces;
};

class ClothSolver {
 public:
  explicit ClothSolver(const ClothSetup& setup);
  ~ClothSolver();

  // `surfaces`: positions of their vertices; `bodies`: where they are, or none: they do not move in
  // the next step. `begins`: refuses free vertices inside a body.
  void set_state(const Points3& positions, const Points3& velocities, const Points3& surfaces,
                 const std::vector<Body>& bodies = {}, bool begins = true);

  // `gravity`: acceleration of each vertex; `held` and `surfaces`: at the end of the step; bodies
  // keep their number and order from step to step. `damping`: mass-proportional, 1/s, on top of the
  // fabrics' own.
  StepReport step(double dt, const Points3& gravity, const Points3& held, const Points3& surfaces,
                  const std::vector<Body>& bodies, double damping,
                  const std::vector<DriveRates>& rates);

  // Differentiates the run by these parameters from now on, with derivatives of 0 to begin with.
  // Throws std::invalid_argument where a parameter names what is not there.
  void follow(const std::vector<SensitivityParameter>& parameters);
  // By parameter, (vertices, 3): derivatives of positions and velocities, m and m/s per unit.
  std::vector<Points3> position_sensitivities() const;
  std::vector<Points3> velocity_sensitivities() const;
  void set_sensitivities(const std::vector<Points3>& x, const std::vector<Points3>& v);
  // By parameter: see Sensitivities::nearest_event.
  std::vector<double> nearest_events() const;
  SensitivityReport sensitivity_report() const;

  // A step of the controller's choice: see StepController::advance, and Stepper for `may_fail`.
  StepReport advance(double& time, double event, const PrescribedMotion& motion, bool may_fail);
  // Rate of the cloth's momentum in the last step, N: the sum of all forces.
  Eigen::Vector3d momentum_rate() const;
  // Force of damping in the last step, N.
  Eigen::Vector3d damping_force() const;

  Points3 positions() const;
  Points3 velocities() const;
  // Force of bodies and smooth surfaces on each free vertex, of holders on each held one, at the
  // end of the last step, N.
  Points3 reactions() const;
  // Which body each vertex touches, or after the bodies which surface (-1: none), and whether it
  // slides.
  std::vector<std::int32_t> contacts() const;
  std::vector<std::int32_t> sliding() const;
  // Which body presses each vertex against that one from the other side (-1: none), and its force
  // on the vertex, N: its share of friction is that of the normal forces.
  std::vector<std::int32_t> opposites() const;
  Points3 opposite_forces() const;

  // Force of the cloth on each vertex of the surfaces at the end of the last step, N.
  Points3 surface_forces() const;

  // Pairs of cloth with cloth and surfaces that bear a force at the end of the last step. Vertices
  // of surfaces come after those of the cloth.
  using Truths = Eigen::Matrix<bool, Eigen::Dynamic, 1>;
  struct PairForces {
    Eigen::Matrix<std::int32_t, Eigen::Dynamic, 4, Eigen::RowMajor> vertices;
    Eigen::Matrix<double, Eigen::Dynamic, 4, Eigen::RowMajor> weights;
    Points3 forces;            // N: on sum w_i x_i
    Eigen::VectorXd distance;  // m
    Truths sliding;
  };
  PairForces pair_forces() const;

  // Of membrane and bending, J, and the gradient of their sum, N.
  std::tuple<double, double, Points3> energies(const Points3& positions);
  // The smallest eigenvalue of K v = lambda M v at `positions`, without contact, 1/s^2: positive
  // where they are stable.
  double lowest_eigenvalue(const Points3& positions);

  const Eigen::VectorXd& masses() const;
  std::string kernel() const;

 private:
  struct Impl;
  const ClothSetup setup_;
  std::unique_ptr<Impl> impl_;

  void begin(const std::vector<Body>& bodies, bool begins = true);
};

}  // namespace sim_core
