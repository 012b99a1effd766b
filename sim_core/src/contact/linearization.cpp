#include <Eigen/Geometry>
#include <Eigen/LU>

#include "contact/contact_set.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::Vector4d;

// How the closest points move over their pieces, and how the normal turns, by a pair's motions m, m_1, m_2: they lie
// where rho is across the directions a_k = sum w_ki x_i, so that
//
//     sum_l a_k . a_l dtheta_l = -(a_k . m + rho . m_k),   dn = (1 - n n^T) (m + sum a_k dtheta_k)/d.
void turn(Pair& pair, const Buffer<double>& x) {
  pair.sliding.setZero();
  pair.turning.setZero();
  if (!pair.active() || pair.at.force.isZero(0.0)) return;
  const FourPoints at = points_of(pair.who, x);
  const int count = (pair.along_first.isZero(0.0) ? 0 : 1) + (pair.along_second.isZero(0.0) ? 0 : 1);
  const double distance = pair.at.gap + pair.thickness;
  const Vector3d n = pair.at.normal, rho = distance * n;
  Eigen::Matrix<double, 3, 2> a;
  a << between_closest(pair.along_first, at), between_closest(pair.along_second, at);
  Eigen::Matrix<double, 2, 9> asked = Eigen::Matrix<double, 2, 9>::Zero();
  for (int k = 0; k < count; ++k) {
    asked.block<1, 3>(k, 0) = -a.col(k).transpose();
    asked.block<1, 3>(k, 3 + 3 * k) = -rho.transpose();
  }
  if (count == 2) {
    const Eigen::Matrix2d inner = a.transpose() * a;
    pair.sliding = inner.inverse() * asked;
  } else if (count == 1) {
    pair.sliding.row(0) = asked.row(0) / a.col(0).squaredNorm();
  }
  Eigen::Matrix<double, 3, 9> way = a * pair.sliding;
  way.leftCols<3>() += Matrix3d::Identity();
  pair.turning = pair.row.turning * (way - n * (n.transpose() * way)) / distance;
}

}  // namespace

void ContactSet::linearize_at(const Buffer<double>& x) {
  for (Pair& pair : pairs_) {
    pair.row = linearize(pair.at);
    turn(pair, x);
  }
}

PairData ContactSet::rows() {
  nodes_.clear();
  weights_.clear();
  stiffness_.clear();
  for (const Pair& pair : pairs_) {
    if (!pair.active()) continue;
    for (int c = 0; c < 4; ++c) {
      nodes_.push_back(pair.who.node[c] < free_nodes_ ? pair.who.node[c] : -1);
    }
    for (const Vector4d* weights : {&pair.weights, &pair.along_first, &pair.along_second}) {
      for (int c = 0; c < 4; ++c) weights_.push_back(static_cast<float>((*weights)[c]));
    }
    const Eigen::Matrix<double, 9, 9> stiffness = pair.stiffness();
    for (int column = 0; column < 9; ++column) {
      for (int r = 0; r < 9; ++r) {
        stiffness_.push_back(static_cast<float>(stiffness(r, column)));
        if (r % 3 == 2) stiffness_.push_back(0.0f);
      }
    }
  }
  return {static_cast<int>(nodes_.size() / 4), nodes_.data(), weights_.data(), stiffness_.data()};
}

void ContactSet::subtract_right_side(Buffer<float>& force) const {
  for (const Pair& pair : pairs_) {
    PairMotions change = -pair.stiffness() * pair.given;
    change.head<3>() += pair.row.force;
    if (change.isZero(0.0)) continue;
    for (int c = 0; c < 4; ++c) {
      if (pair.who.node[c] >= free_nodes_) continue;
      at_node(force, pair.who.node[c]) -=
          (pair.weights[c] * change.segment<3>(0) + pair.along_first[c] * change.segment<3>(3) +
           pair.along_second[c] * change.segment<3>(6))
              .cast<float>();
    }
  }
}

}  // namespace sim_core
