#include "cloth/membrane.hpp"

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

// From the values at the angles of the table's rows to the coefficients of the quartic in y = cos(2 angle).
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
    const bool other = groups.empty() || fabrics.of_triangle[groups.back()[0]] != fabrics.of_triangle[t];
    if (other || groups.back().size() == membrane_lanes) groups.emplace_back();
    groups.back().push_back(t);
  }
  return groups;
}

}  // namespace

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
      const int pairs[9][2] = {{0, 1}, {1, 0}, {0, 2}, {2, 0}, {1, 2}, {2, 1}, {0, 0}, {1, 1}, {2, 2}};
      for (int k = 0; k < 9; ++k) slots[k] = numbering.membrane.slot(n[pairs[k][0]], n[pairs[k][1]]);
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

void Membrane::lag_from(const ClothKernel& kernel, const double* x, double share) {
  data_.lag = nullptr;
  if (share == 0.0 || std::none_of(tabulated_.begin(), tabulated_.end(), [](char one) { return one != 0; })) return;
  lag_.resize(9L * membrane_lanes * data_.groups);
  kernel.membrane_lag(data_, x, share, lag_.data());
  data_.lag = lag_.data();
}

}  // namespace sim_core
