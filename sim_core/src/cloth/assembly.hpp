// Energies of a sheet, their gradient, and the matrix of Newton's method.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

#include "cloth/constants.hpp"
#include "cloth/inertia.hpp"
#include "cloth/mesh.hpp"
#include "cloth/numbering.hpp"
#include "cloth/problem.hpp"
#include "math/buffer.hpp"

namespace sim_core {

// The stencils of the plate element, laid out for the kernels.
class Bending {
 public:
  Bending(const ClothMesh& mesh, const std::vector<Stencil>& stencils, const Fabrics& fabrics,
          const Numbering& numbering, const Pattern& pattern);
  Bending(const Bending&) = delete;

  const BendingData& data() const { return data_; }

 private:
  std::vector<int> begin_{0}, nodes_, slot_begin_, slots_, fabric_;
  Buffer<double> weights_;
  std::vector<double> area_, spacing2_, rigidity_;
  std::vector<SofteningData> softening_;
  BendingData data_{};
};

// A number of fabrics that changes a part of their bending. With the factors a, b and c of warp,
// weft and twist the rigidity is S D S, S = diag(sqrt a, sqrt b, sqrt c).
enum class BendingNumber { warp, weft, twist, softening };
constexpr int bending_numbers = 4;

// The bending of a cloth with a number of its fabrics a little larger, and a little smaller.
struct BendingDifference {
  Bending larger, smaller;
};

// Triangles in groups of one fabric, and the law of each fabric.
class Membrane {
 public:
  Membrane(const ClothMesh& mesh, const Numbering& numbering, const Fabrics& fabrics);
  Membrane(const Membrane&) = delete;

  const MembraneData& data() const { return data_; }
  void set_lagged_stretch(const ClothKernel& kernel, const double* x, double fraction);
  bool lags() const;

 private:
  Buffer<int> nodes_, slots_, fabric_;
  Buffer<double> shape_, area_, law_, lag_;
  Buffer<char> tabulated_;
  MembraneData data_{};
};

// Numbers of a matrix that a factor is of, which outlive the state that they are of.
struct NeighbourNumbers {
  Buffer<float> scalars, blocks;
};

// What a change or a fold may be without entering the matrix.
struct MatrixApproximation {
  double stiffening_change = factors::stiffening_change, fold_min = factors::fold_min;
};

class Assembly {
 public:
  // `surface_vertices`: their number.
  Assembly(const ClothKernel& kernel, const ClothMesh& mesh, const Fabrics& fabrics,
           const std::vector<std::int32_t>& held, int surface_vertices,
           MatrixApproximation approximation = {});
  Assembly(const Assembly&) = delete;

  const ClothKernel kernel;
  const std::vector<Stencil> stencils, compact_stencils;
  const Numbering numbering;
  Eigen::VectorXd mass_of_vertex;  // kg
  Buffer<double> mass;             // (nodes), 0 on surfaces
  Buffer<double> own_damping;      // (nodes): of the fabrics, 1/s

  // At the positions last evaluated.
  Buffer<double> gradient;                             // (nodes, 4), N
  double membrane_energy = 0.0, bending_energy = 0.0;  // J
  ClothMatrix matrix{};
  // Whether the matrix has the positive part of the stress and of the law only, as that of a convex
  // energy does.
  bool use_convex_hessian = false;

  void evaluate(const Buffer<double>& x, bool with_matrix);
  enum class Energy { all, membrane, bending };
  // Sets `out` (nodes, 4) to the gradient of an energy at x, N, and changes nothing else.
  void gradient_of(Energy energy, const Buffer<double>& x, Buffer<double>& out) const;
  // Adds to `changes` how the gradient of bending at x changes along vectors (nodes, 4), at most
  // `solve_group` of them.
  void add_bending_changes(const Buffer<double>& x, const std::vector<const double*>& along,
                           const std::vector<double*>& changes) const;
  // Sets `out` (nodes, 4) to the derivative of the gradient at x by the logarithm of a factor of a
  // number of all fabrics, N, and changes nothing that can be seen.
  void gradient_by(BendingNumber number, const Buffer<double>& x, Buffer<double>& out);
  // From now on stretching lags behind what it is at x by this fraction, none if 0: see
  // kernels/membrane.hpp.
  void set_lagged_stretch(const Buffer<double>& x, double fraction) {
    membrane_.set_lagged_stretch(kernel, x.data(), fraction);
  }
  // Whether that changes anything: only where the law is not convex there.
  bool lags() const { return membrane_.lags(); }
  // Inertia and damping [1/s], on top of the fabrics' own, of a step.
  void set_diagonal(const Inertia& inertia, double damping);
  // Mean of a node's block on the diagonal, N/m.
  double own_stiffness(int node) const;
  // That block, N/m.
  Eigen::Matrix3d own_block(int node) const;

  // K's neighbour that the factor is of: the positive part of the stress and of the law, and the
  // plate element that couples six nodes in place of twelve.
  ClothMatrix neighbour(const Buffer<double>& x, NeighbourNumbers& numbers);

 private:
  void assemble_bending();
  void reserve_folds();
  const BendingDifference& difference_by(BendingNumber number);
  Bending bending_with(const Fabrics& fabrics) const;

  const ClothMesh mesh_;
  const Fabrics fabrics_;

  Membrane membrane_;
  Bending bending_, compact_bending_;
  // By number, made when first asked for.
  std::array<std::unique_ptr<BendingDifference>, bending_numbers> differences_;
  std::vector<float> rigidity_scale_;  // (triangles): 1 over the largest of its fabric, 1/(N m)
  std::vector<int> bending_diagonal_, membrane_diagonal_;  // slots
  Buffer<float> scalars_, blocks_, diagonal_;
  Buffer<float> stiffening_, assembled_stiffening_;  // (triangles, 2)
  Buffer<double> unused_;
  MatrixApproximation approximation_;
  std::vector<int> fold_begin_, fold_nodes_;
  Buffer<float> fold_vectors_, fold_coefficients_;
  FoldData folds_{}, no_folds_{};
};

}  // namespace sim_core
