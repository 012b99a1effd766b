#include "cloth/membrane.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <cmath>

namespace sim_core {

Membrane::Membrane(const ClothMesh& mesh, const Numbering& numbering, const Fabrics& fabrics)
    : constant_(std::all_of(fabrics.list.begin(), fabrics.list.end(),
                            [](const ClothProperties& fabric) { return fabric.stretching.constant(); })) {
  constexpr int W = membrane_lanes;
  const int count = static_cast<int>(mesh.triangles.rows()), groups = (count + W - 1) / W;
  nodes_.assign(3 * W * groups, 0);
  slots_.assign(9 * W * groups, -1);
  shape_.assign(4 * W * groups, 0.0);
  area_.assign(W * groups, 0.0);
  stiffness_.assign(4 * W * groups, 0.0);
  for (int t = 0; t < count; ++t) {
    const int group = t / W, lane = t % W;
    int n[3];
    for (int c = 0; c < 3; ++c) {
      n[c] = numbering.node[mesh.triangles(t, c)];
      nodes_[(3 * group + c) * W + lane] = n[c];
    }
    const Eigen::Vector2d p = mesh.rest.row(mesh.triangles(t, 0));
    Eigen::Matrix2d edges;
    edges.col(0) = mesh.rest.row(mesh.triangles(t, 1)).transpose() - p;
    edges.col(1) = mesh.rest.row(mesh.triangles(t, 2)).transpose() - p;
    const Eigen::Matrix2d inverse = edges.inverse();  // rows: gradients of the shape functions
    for (int c = 0; c < 4; ++c) shape_[(4 * group + c) * W + lane] = inverse(c / 2, c % 2);
    area_[group * W + lane] = mesh.area[t];
    tables_.push_back(fabrics.at(t).stretching);
    for (int c = 0; c < 4; ++c) stiffness_[(4 * group + c) * W + lane] = tables_[t].k(0, c);
    int* slots = &slots_[9 * (group * W + lane)];
    const int pairs[9][2] = {{0, 1}, {1, 0}, {0, 2}, {2, 0}, {1, 2}, {2, 1}, {0, 0}, {1, 1}, {2, 2}};
    for (int k = 0; k < 9; ++k) slots[k] = numbering.membrane.slot(n[pairs[k][0]], n[pairs[k][1]]);
  }
  // Lanes that pad the last group read its first triangle and weigh nothing.
  for (int t = count; t < groups * W; ++t) {
    const int group = t / W, lane = t % W;
    for (int c = 0; c < 3; ++c) nodes_[(3 * group + c) * W + lane] = nodes_[3 * group * W + c * W];
  }
  data_ = {groups, nodes_.data(), shape_.data(), area_.data(), stiffness_.data(), slots_.data()};
}

void Membrane::read_table(const Buffer<double>& x) {
  if (constant_) return;
  for (int group = 0; group < data_.groups; ++group) {
    for (int lane = 0; lane < membrane_lanes; ++lane) {
      if (area_[group * membrane_lanes + lane] != 0.0) read_table(x, group, lane);
    }
  }
}

void Membrane::read_table(const Buffer<double>& x, int group, int lane) {
  constexpr int W = membrane_lanes;
  const double* p[3];
  for (int c = 0; c < 3; ++c) p[c] = &x[4L * nodes_[(3 * group + c) * W + lane]];
  const double* s = &shape_[4L * W * group];
  double f[2][3];
  for (int c = 0; c < 3; ++c) {
    const double a = p[1][c] - p[0][c], b = p[2][c] - p[0][c];
    f[0][c] = a * s[lane] + b * s[2 * W + lane];
    f[1][c] = a * s[W + lane] + b * s[3 * W + lane];
  }
  double g00 = -0.5, g11 = -0.5, g01 = 0.0;
  for (int c = 0; c < 3; ++c) {
    g00 += 0.5 * f[0][c] * f[0][c];
    g11 += 0.5 * f[1][c] * f[1][c];
    g01 += 0.5 * f[0][c] * f[1][c];
  }
  // The larger principal stretch, and its angle to the first axis in 0 ... pi/2.
  const double mean = 0.5 * (g00 + g11), half = 0.5 * (g00 - g11), radius = std::hypot(half, g01);
  const double stretch = std::sqrt(std::max(0.0, 1.0 + 2.0 * (mean + radius))) - 1.0;
  const double share = std::clamp(stretch / table_stretch, 0.0, 1.0);
  if (!std::isfinite(radius)) return;
  const double angle = 0.5 * std::abs(std::atan2(g01, half));
  const double place = std::min(angle / (M_PI / 8.0), 4.0);
  const int row = std::min(static_cast<int>(place), 3);
  const double between = place - row;
  const StretchTable& table = tables_[group * W + lane];
  for (int c = 0; c < 4; ++c) {
    const double far = (1.0 - between) * table.k(1 + row, c) + between * table.k(2 + row, c);
    stiffness_[(4 * group + c) * W + lane] = (1.0 - share) * table.k(0, c) + share * far;
  }
}

}  // namespace sim_core
