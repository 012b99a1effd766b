// Dynamics of a sheet in contact with moving bodies: implicit Euler, exact Coulomb friction.
#pragma once

#include <Eigen/Core>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <new>
#include <string>
#include <vector>

#include "cloth_mesh.hpp"
#include "cloth_problem.hpp"

namespace sim_core {

using Points3 = Eigen::Matrix<double, Eigen::Dynamic, 3, Eigen::RowMajor>;

template <class T>
struct CacheAligned {
  using value_type = T;
  static constexpr std::align_val_t alignment{64};
  CacheAligned() = default;
  template <class U>
  CacheAligned(const CacheAligned<U>&) {}
  T* allocate(std::size_t n) { return static_cast<T*>(::operator new(n * sizeof(T), alignment)); }
  void deallocate(T* p, std::size_t) { ::operator delete(p, alignment); }
  friend bool operator==(const CacheAligned&, const CacheAligned&) { return true; }
};
template <class T>
using Buffer = std::vector<T, CacheAligned<T>>;

// Stiffness against stretching after [Wang et al. 2011]: k0 ... k3 [N/m] of the energy k0 G00^2/2 + k1 G00 G11 +
// k2 G11^2/2 + k3 G01^2. Row 0 holds at no strain, rows 1 ... 5 at `table_stretch` with the larger principal stretch
// 0, 22.5, ..., 90 degrees from the first axis; in between it is bilinear.
struct StretchTable {
  Eigen::Matrix<double, 6, 4, Eigen::RowMajor> k;
  bool constant() const;
};
constexpr double table_stretch = 1.0 / 6.0;

struct ClothProperties {
  double density;  // kg/m^2
  StretchTable stretching;
  Rigidity rigidity;
};

// A body that cloth touches, at the end of a step. Its own axes: a plane fills z < 0, a sphere has radius size[0], a
// box reaches from -size to size.
struct Body {
  enum Shape : int { plane = 0, sphere = 1, box = 2 };
  int shape;
  double mu;
  Eigen::Vector3d size, origin;
  Eigen::Matrix3d rotation;
};

struct ClothSettings {
  double tolerance;  // N: largest residual force of a node
  int newton_max;    // iterations of Newton's method in a step
  int krylov_max;    // of GMRES in one of those
  double krylov_tolerance;
  int refactor_after;  // GMRES iterations that a stale factor may cost
  int halvings_max;    // of a step that does not converge
};

struct StepReport {
  bool converged = true;
  double residual = 0.0;  // N: worst over the substeps
  int substeps = 0, newton = 0, krylov = 0, factorizations = 0, contacts = 0, sliding = 0;
};

// CPU seconds by phase, since construction.
struct ClothPhases {
  double assembly = 0.0, factorization = 0.0, krylov = 0.0, contact = 0.0;
};

class ClothSolver {
 public:
  // `held`: vertices whose positions are prescribed; `clamped`: boundary edges whose outward slope is prescribed.
  ClothSolver(const Points2& rest, const Triangles& triangles, const ClothProperties& properties,
              const std::vector<std::int32_t>& held, const Edges& clamped, const ClothSettings& settings);
  ~ClothSolver();

  void set_state(const Points3& positions, const Points3& velocities, const Points3& slopes);

  // `gravity`: acceleration of each vertex; `held` and `slopes`: at the end of the step; bodies keep their number and
  // order from step to step. `damping`: mass-proportional, 1/s.
  StepReport step(double dt, const Points3& gravity, const Points3& held, const Points3& slopes,
                  const std::vector<Body>& bodies, double damping);

  Points3 positions() const;
  Points3 velocities() const;
  // Force of bodies on each free vertex, of holders on each held one, at the end of the last step, N.
  Points3 reactions() const;
  // Which body each vertex touches (-1: none), and whether it slides.
  std::vector<std::int32_t> contacts() const;
  std::vector<std::int32_t> sliding() const;

  struct Energies {
    double membrane, bending;
    Points3 gradient;
  };
  Energies energies(const Points3& positions, const Points3& slopes);
  // K v with the matrix of Newton's method at `positions`, without mass; rows of held vertices are 0.
  Points3 stiffness_times(const Points3& positions, const Points3& slopes, const Points3& v);
  // Relative error of a solve with the factor of its approximation, mass / dt^2 and all: for tests.
  double factor_error(const Points3& positions, const Points3& slopes, double dt);

  const Eigen::VectorXd& masses() const;
  ClothPhases phases() const;
  double factor_flops() const;
  std::size_t factor_floats() const;
  std::string kernel() const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

}  // namespace sim_core
