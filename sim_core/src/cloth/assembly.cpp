#include "cloth/assembly.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <vector>

namespace sim_core {
namespace {

// A, B, C, D of k0 ... k3: see kernels/stretching.hpp.
Eigen::RowVector4d combined(const Eigen::RowVector4d& k) {
  return {k[0] + 2.0 * k[1] + k[2], k[0] - k[2], k[0] - 2.0 * k[1] + k[2], 2.0 * k[3]};
}

// From the values at the angles of the table's rows to the coefficients of the quartic in y = cos(2
// angle).
Eigen::Matrix<double, 5, 5> powers_of_rows() {
  Eigen::Matrix<double, 5, 5> at_rows;
  const double y[5] = {1.0, std::sqrt(0.5), 0.0, -std::sqrt(0.5), -1.0};
  for (int r = 0; r < 5; ++r) {
    for (int j = 0; j < 5; ++j) at_rows(r, j) = std::pow(y[r], j);
  }
  return at_rows.inverse();
}

// Triangles of one fabric in groups, one after the other.
std::vector<std::vector<int>> grouped(const Fabrics& fabrics) {
  std::vector<std::vector<int>> groups;
  const int count = static_cast<int>(fabrics.of_triangle.size());
  for (int t = 0; t < count; ++t) {
    const bool other =
        groups.empty() || fabrics.of_triangle[groups.back()[0]] != fabrics.of_triangle[t];
    if (other || groups.back().size() == membrane_lanes) groups.emplace_back();
    groups.back().push_back(t);
  }
  return groups;
}

// Half of the width of a difference over the logarithm of a factor: the error by the third
// derivative is 1e-9, and that by rounding less.
constexpr double log_factor_probe = 1e-4;

Fabrics scaled(Fabrics fabrics, BendingNumber number, double factor) {
  for (ClothProperties& fabric : fabrics.list) {
    if (number == BendingNumber::softening) {
      fabric.softening *= factor;
      continue;
    }
    Eigen::Vector3d roots = Eigen::Vector3d::Ones();
    roots[static_cast<int>(number)] = std::sqrt(factor);
    fabric.rigidity = roots.asDiagonal() * fabric.rigidity * roots.asDiagonal();
  }
  return fabrics;
}

}  // namespace

Bending::Bending(const ClothMesh& mesh, const std::vector<Stencil>& stencils,
                 const Fabrics& fabrics, const Numbering& numbering, const Pattern& pattern)
    : fabric_(fabrics.of_triangle) {
  const int count = static_cast<int>(stencils.size());
  for (int t = 0; t < count; ++t) {
    const Stencil& stencil = stencils[t];
    for (std::size_t i = 0; i < stencil.nodes.size(); ++i) {
      nodes_.push_back(numbering.node[stencil.nodes[i]]);
      for (int c = 0; c < 3; ++c) weights_.push_back(stencil.weights(i, c));
      weights_.push_back(0.0);
    }
    slot_begin_.push_back(static_cast<int>(slots_.size() / 2));
    for (std::size_t i = 0; i < stencil.nodes.size(); ++i) {
      for (std::size_t j = 0; j <= i; ++j) {
        const int a = numbering.node[stencil.nodes[i]], b = numbering.node[stencil.nodes[j]];
        slots_.push_back(pattern.slot(a, b));
        slots_.push_back(pattern.slot(b, a));
      }
    }
    begin_.push_back(static_cast<int>(nodes_.size()));
    area_.push_back(mesh.area[t]);
    spacing2_.push_back(2.0 * mesh.area[t]);
  }
  for (const ClothProperties& fabric : fabrics.list) {
    const Rigidity& d = fabric.rigidity;
    rigidity_.insert(rigidity_.end(), {d(0, 0), d(0, 1), d(0, 2), d(1, 1), d(1, 2), d(2, 2)});
    softening_.push_back({fabric.softening, std::sqrt(d(0, 0) * d(1, 1))});
  }
  data_ = {count,
           begin_.data(),
           nodes_.data(),
           weights_.data(),
           area_.data(),
           spacing2_.data(),
           fabric_.data(),
           rigidity_.data(),
           softening_.data(),
           slot_begin_.data(),
           slots_.data()};
}

Membrane::Membrane(const ClothMesh& mesh, const Numbering& numbering, const Fabrics& fabrics) {
  constexpr int W = membrane_lanes;
  const std::vector<std::vector<int>> members = grouped(fabrics);
  const int groups = static_cast<int>(members.size());
  nodes_.assign(3 * W * groups, 0);
  slots_.assign(9 * W * groups, -1);
  shape_.assign(4 * W * groups, 0.0);
  area_.assign(W * groups, 0.0);
  for (int group = 0; group < groups; ++group) {
    fabric_.push_back(fabrics.of_triangle[members[group][0]]);
    for (int lane = 0; lane < W; ++lane) {
      // Lanes that pad a group read its first triangle and weigh nothing.
      const bool pads = lane >= static_cast<int>(members[group].size());
      const int t = members[group][pads ? 0 : lane];
      int n[3];
      for (int c = 0; c < 3; ++c) {
        n[c] = numbering.node[mesh.triangles(t, c)];
        nodes_[(3 * group + c) * W + lane] = n[c];
      }
      if (pads) continue;
      const Eigen::Vector2d p = mesh.rest.row(mesh.triangles(t, 0));
      Eigen::Matrix2d edges;
      edges.col(0) = mesh.rest.row(mesh.triangles(t, 1)).transpose() - p;
      edges.col(1) = mesh.rest.row(mesh.triangles(t, 2)).transpose() - p;
      const Eigen::Matrix2d inverse = edges.inverse();  // rows: gradients of the shape functions
      for (int c = 0; c < 4; ++c) shape_[(4 * group + c) * W + lane] = inverse(c / 2, c % 2);
      area_[group * W + lane] = mesh.area[t];
      int* slots = &slots_[9 * (group * W + lane)];
      const int pairs[9][2] = {{0, 1}, {1, 0}, {0, 2}, {2, 0}, {1, 2},
                               {2, 1}, {0, 0}, {1, 1}, {2, 2}};
      for (int k = 0; k < 9; ++k)
        slots[k] = numbering.membrane.slot(n[pairs[k][0]], n[pairs[k][1]]);
    }
  }
  const Eigen::Matrix<double, 5, 5> powers = powers_of_rows();
  for (const ClothProperties& fabric : fabrics.list) {
    const StretchTable& table = fabric.stretching;
    const Eigen::RowVector4d none = combined(table.row(0));
    Eigen::Matrix<double, 5, 4> more;
    for (int r = 0; r < 5; ++r) more.row(r) = combined(table.row(1 + r) - table.row(0));
    const Eigen::Matrix<double, 5, 4> in_y = powers * more;
    law_.insert(law_.end(), none.data(), none.data() + 4);
    law_.insert(law_.end(), in_y.data(), in_y.data() + 20);  // column by column
    tabulated_.push_back(table.bottomRows<5>() != table.row(0).replicate<5, 1>());
  }
  data_ = {groups,      nodes_.data(),     shape_.data(), area_.data(), fabric_.data(),
           law_.data(), tabulated_.data(), slots_.data(), nullptr};
}

void Membrane::set_lagged_stretch(const ClothKernel& kernel, const double* x, double fraction) {
  data_.lag = nullptr;
  if (fraction == 0.0 ||
      std::none_of(tabulated_.begin(), tabulated_.end(), [](char flag) { return flag != 0; }))
    return;
  lag_.resize(9L * membrane_lanes * data_.groups);
  kernel.membrane_lag(data_, x, fraction, lag_.data());
  data_.lag = lag_.data();
}

bool Membrane::lags() const {
  if (!data_.lag) return false;
  constexpr int W = membrane_lanes, strains = 3 * W, numbers = 9 * W;
  for (int group = 0; group < data_.groups; ++group) {
    const double* of_group = data_.lag + 1L * numbers * group;
    if (std::any_of(of_group + strains, of_group + numbers, [](double c) { return c != 0.0; }))
      return true;
  }
  return false;
}

Assembly::Assembly(const ClothKernel& kernel_in, const ClothMesh& mesh, const Fabrics& fabrics,
                   const std::vector<std::int32_t>& held, int surface_vertices,
                   MatrixApproximation approximation)
    : kernel(kernel_in),
      stencils(bending_stencils(mesh, fabrics)),
      compact_stencils(bending_stencils(mesh, fabrics, true)),
      numbering(mesh, stencils, compact_stencils, held, surface_vertices),
      mass_of_vertex(Eigen::VectorXd::Zero(mesh.rest.rows())),
      mass(numbering.nodes, 0.0),
      own_damping(numbering.nodes, 0.0),
      gradient(4L * numbering.nodes, 0.0),
      mesh_(mesh),
      fabrics_(fabrics),
      membrane_(mesh, numbering, fabrics),
      bending_(mesh, stencils, fabrics, numbering, numbering.bending),
      compact_bending_(mesh, compact_stencils, fabrics, numbering, numbering.compact_bending),
      scalars_(numbering.bending.node.size(), 0.0f),
      blocks_(12 * numbering.membrane.node.size(), 0.0f),
      diagonal_(numbering.free_nodes, 0.0f),
      stiffening_(2 * mesh.triangles.rows(), 0.0f),
      assembled_stiffening_(2 * mesh.triangles.rows(), -1.0f),
      unused_(4L * numbering.nodes, 0.0),
      approximation_(approximation) {
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    const ClothProperties& fabric = fabrics.at(t);
    rigidity_scale_.push_back(static_cast<float>(1.0 / fabric.rigidity.cwiseAbs().maxCoeff()));
    for (int c = 0; c < 3; ++c) {
      mass_of_vertex[mesh.triangles(t, c)] += fabric.density * mesh.area[t] / 3.0;
      own_damping[numbering.node[mesh.triangles(t, c)]] = fabric.damping;
    }
  }
  for (int i = 0; i < numbering.vertices; ++i) mass[numbering.node[i]] = mass_of_vertex[i];
  for (int i = 0; i < numbering.free_nodes; ++i) {
    bending_diagonal_.push_back(numbering.bending.slot(i, i));
    membrane_diagonal_.push_back(numbering.membrane.slot(i, i));
  }
  matrix = {numbering.free_nodes,
            numbering.bending.begin.data(),
            numbering.bending.node.data(),
            scalars_.data(),
            numbering.membrane.begin.data(),
            numbering.membrane.node.data(),
            blocks_.data(),
            diagonal_.data(),
            &folds_,
            nullptr};
  reserve_folds();
}

void Assembly::reserve_folds() {
  const BendingData& data = bending_.data();
  fold_begin_.assign(data.triangles + 1, 0);
  fold_nodes_.assign(data.begin[data.triangles], 0);
  fold_vectors_.assign(8L * data.begin[data.triangles], 0.0f);
  fold_coefficients_.assign(3L * data.triangles, 0.0f);
  folds_ = {numbering.free_nodes,     approximation_.fold_min, 0,
            fold_begin_.data(),       fold_nodes_.data(),      fold_vectors_.data(),
            fold_coefficients_.data()};
}

void Assembly::evaluate(const Buffer<double>& x, bool with_matrix) {
  std::fill(gradient.begin(), gradient.end(), 0.0);
  if (with_matrix) std::fill(blocks_.begin(), blocks_.end(), 0.0f);
  membrane_energy = kernel.membrane(membrane_.data(), x.data(), gradient.data(),
                                    with_matrix ? blocks_.data() : nullptr, use_convex_hessian);
  bending_energy = kernel.bending(bending_.data(), x.data(), gradient.data(), stiffening_.data(),
                                  with_matrix ? &folds_ : nullptr);
  if (with_matrix) assemble_bending();
}

void Assembly::gradient_of(Energy energy, const Buffer<double>& x, Buffer<double>& out) const {
  std::fill(out.begin(), out.end(), 0.0);
  if (energy != Energy::bending) {
    kernel.membrane(membrane_.data(), x.data(), out.data(), nullptr, false);
  }
  if (energy != Energy::membrane) {
    kernel.bending(bending_.data(), x.data(), out.data(), nullptr, nullptr);
  }
}

void Assembly::add_bending_changes(const Buffer<double>& x, const std::vector<const double*>& along,
                                   const std::vector<double*>& changes) const {
  kernel.bending_changes(bending_.data(), x.data(), static_cast<int>(along.size()), along.data(),
                         changes.data());
}

Bending Assembly::bending_with(const Fabrics& fabrics) const {
  return Bending(mesh_, bending_stencils(mesh_, fabrics), fabrics, numbering, numbering.bending);
}

const BendingDifference& Assembly::difference_by(BendingNumber number) {
  std::unique_ptr<BendingDifference>& known = differences_[static_cast<int>(number)];
  if (!known) {
    const double factor = std::exp(log_factor_probe);
    known.reset(new BendingDifference{bending_with(scaled(fabrics_, number, factor)),
                                      bending_with(scaled(fabrics_, number, 1.0 / factor))});
  }
  return *known;
}

void Assembly::gradient_by(BendingNumber number, const Buffer<double>& x, Buffer<double>& out) {
  const BendingDifference& difference = difference_by(number);
  Buffer<double> smaller(out.size(), 0.0);
  std::fill(out.begin(), out.end(), 0.0);
  kernel.bending(difference.larger.data(), x.data(), out.data(), nullptr, nullptr);
  kernel.bending(difference.smaller.data(), x.data(), smaller.data(), nullptr, nullptr);
  for (std::size_t k = 0; k < out.size(); ++k)
    out[k] = (out[k] - smaller[k]) / (2.0 * log_factor_probe);
}

void Assembly::assemble_bending() {
  float change_max = 0.0f;
  for (std::size_t t = 0; t < rigidity_scale_.size(); ++t) {
    change_max = std::max(
        {change_max, std::abs(stiffening_[2 * t] - assembled_stiffening_[2 * t]),
         rigidity_scale_[t] * std::abs(stiffening_[2 * t + 1] - assembled_stiffening_[2 * t + 1])});
  }
  if (!(change_max > static_cast<float>(approximation_.stiffening_change))) return;
  std::fill(scalars_.begin(), scalars_.end(), 0.0f);
  kernel.bending_matrix(bending_.data(), stiffening_.data(), scalars_.data());
  assembled_stiffening_ = stiffening_;
}

void Assembly::set_diagonal(const Inertia& inertia, double damping) {
  for (int i = 0; i < numbering.free_nodes; ++i) {
    const double viscous = (damping + own_damping[i]) / inertia.span[i];
    diagonal_[i] = static_cast<float>(mass[i] * (inertia.rate[i] + viscous));
  }
}

double Assembly::own_stiffness(int node) const {
  const float* block = &blocks_[12L * membrane_diagonal_[node]];
  const double mean_stiffness =
      diagonal_[node] + scalars_[bending_diagonal_[node]] + (block[0] + block[5] + block[10]) / 3.0;
  return std::max(mean_stiffness, static_cast<double>(diagonal_[node]));
}

Eigen::Matrix3d Assembly::own_block(int node) const {
  const Eigen::Map<const Eigen::Matrix3f, 0, Eigen::OuterStride<4>> block(
      &blocks_[12L * membrane_diagonal_[node]]);
  const double alike = diagonal_[node] + scalars_[bending_diagonal_[node]];
  const Eigen::Matrix3d stiffness_block =
      alike * Eigen::Matrix3d::Identity() + block.cast<double>();
  return stiffness_block + std::max(0.0, diagonal_[node] - stiffness_block.trace() / 3.0) *
                               Eigen::Matrix3d::Identity();
}

ClothMatrix Assembly::neighbour(const Buffer<double>& x, NeighbourNumbers& numbers) {
  numbers.blocks.assign(blocks_.size(), 0.0f);
  kernel.membrane(membrane_.data(), x.data(), unused_.data(), numbers.blocks.data(), true);
  numbers.scalars.assign(numbering.compact_bending.node.size(), 0.0f);
  kernel.bending_matrix(compact_bending_.data(), stiffening_.data(), numbers.scalars.data());
  ClothMatrix out = matrix;
  out.membrane = numbers.blocks.data();
  out.bending_begin = numbering.compact_bending.begin.data();
  out.bending_node = numbering.compact_bending.node.data();
  out.bending = numbers.scalars.data();
  out.folds = &no_folds_;
  out.pairs = nullptr;
  return out;
}

}  // namespace sim_core
