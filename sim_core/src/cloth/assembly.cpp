#include "cloth/assembly.hpp"

#include <algorithm>
#include <cmath>

namespace sim_core {

Assembly::Assembly(const ClothKernel& kernel_in, const ClothMesh& mesh, const Fabrics& fabrics,
                   const std::vector<std::int32_t>& held, int others, int bones, const FactorSettings& settings)
    : kernel(kernel_in),
      stencils(bending_stencils(mesh, fabrics)),
      compact_stencils(bending_stencils(mesh, fabrics, true)),
      numbering(mesh, stencils, compact_stencils, held, others, bones),
      mass_of_vertex(Eigen::VectorXd::Zero(mesh.rest.rows())),
      mass(numbering.nodes, 0.0),
      own_damping(numbering.nodes, 0.0),
      gradient(4L * numbering.nodes, 0.0),
      membrane_(mesh, numbering, fabrics),
      bending_(mesh, stencils, fabrics, numbering, numbering.bending),
      compact_bending_(mesh, compact_stencils, fabrics, numbering, numbering.compact_bending),
      scalars_(numbering.bending.node.size(), 0.0f),
      blocks_(12 * numbering.membrane.node.size(), 0.0f),
      diagonal_(numbering.free_nodes, 0.0f),
      stiffening_(2 * mesh.triangles.rows(), 0.0f),
      assembled_stiffening_(2 * mesh.triangles.rows(), -1.0f),
      unused_(4L * numbering.nodes, 0.0),
      settings_(settings) {
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
  fold_coefficients_.assign(2L * data.triangles, 0.0f);
  folds_ = {numbering.free_nodes, settings_.fold_smallest,  0, fold_begin_.data(), fold_nodes_.data(),
            fold_vectors_.data(), fold_coefficients_.data()};
}

void Assembly::evaluate(const Buffer<double>& x, bool with_matrix) {
  std::fill(gradient.begin(), gradient.end(), 0.0);
  if (with_matrix) std::fill(blocks_.begin(), blocks_.end(), 0.0f);
  membrane_energy =
      kernel.membrane(membrane_.data(), x.data(), gradient.data(), with_matrix ? blocks_.data() : nullptr, definite);
  bending_energy =
      kernel.bending(bending_.data(), x.data(), gradient.data(), stiffening_.data(), with_matrix ? &folds_ : nullptr);
  if (with_matrix) assemble_bending();
}

void Assembly::assemble_bending() {
  float change_max = 0.0f;
  for (std::size_t t = 0; t < rigidity_scale_.size(); ++t) {
    change_max = std::max({change_max, std::abs(stiffening_[2 * t] - assembled_stiffening_[2 * t]),
                           rigidity_scale_[t] * std::abs(stiffening_[2 * t + 1] - assembled_stiffening_[2 * t + 1])});
  }
  if (!(change_max > static_cast<float>(settings_.stiffening_change))) return;
  std::fill(scalars_.begin(), scalars_.end(), 0.0f);
  kernel.bending_matrix(bending_.data(), stiffening_.data(), scalars_.data());
  assembled_stiffening_ = stiffening_;
}

void Assembly::set_diagonal(double dt, double damping) {
  for (int i = 0; i < numbering.free_nodes; ++i) {
    diagonal_[i] = static_cast<float>(mass[i] * (1.0 / (dt * dt) + (damping + own_damping[i]) / dt));
  }
}

double Assembly::own_stiffness(int node) const {
  const float* block = &blocks_[12L * membrane_diagonal_[node]];
  return diagonal_[node] + scalars_[bending_diagonal_[node]] + (block[0] + block[5] + block[10]) / 3.0;
}

Eigen::Matrix3d Assembly::own_block(int node) const {
  const Eigen::Map<const Eigen::Matrix3f, 0, Eigen::OuterStride<4>> block(&blocks_[12L * membrane_diagonal_[node]]);
  const double alike = diagonal_[node] + scalars_[bending_diagonal_[node]];
  return alike * Eigen::Matrix3d::Identity() + block.cast<double>();
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
