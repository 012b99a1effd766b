#include "contact/pair.hpp"

#include <cmath>

namespace sim_core {

using Eigen::Vector3d;

PairPast::PairPast(const Pair& pair)
    : who(pair.who),
      feature(pair.feature),
      mode(pair.row.mode),
      force(pair.at.force),
      change(pair.change),
      normal(pair.at.normal),
      middle(pair.middle),
      scale(pair.scale),
      penalty_scale(pair.penalty_scale),
      missed(violation(pair.at, pair.row.mode)) {}

PairMotions Pair::motions(const Buffer<float>& change, int free_nodes) const {
  PairMotions out = given;
  for (int c = 0; c < 4; ++c) {
    if (who.node[c] >= free_nodes) continue;
    const Vector3d way = at_node(change, who.node[c]).cast<double>();
    out.segment<3>(0) += weights[c] * way;
    out.segment<3>(3) += along_first[c] * way;
    out.segment<3>(6) += along_second[c] * way;
  }
  return out;
}

Eigen::Matrix<double, 9, 9> Pair::stiffness() const {
  Eigen::Matrix<double, 9, 9> out;
  out.topRows<3>() = -turning;
  out.topLeftCorner<3, 3>() += row.stiffness;
  out.middleRows<3>(3) = -at.force * sliding.row(0);
  out.bottomRows<3>() = -at.force * sliding.row(1);
  return out;
}

Vector3d Pair::motion(const Buffer<float>& change, int free_nodes) const {
  Vector3d out = given.head<3>();
  for (int c = 0; c < 4; ++c) {
    if (who.node[c] < free_nodes) out += weights[c] * at_node(change, who.node[c]).cast<double>();
  }
  return out;
}

Vector3d Pair::force_change(const Buffer<float>& change, int free_nodes) const {
  const PairMotions way = motions(change, free_nodes);
  return row.force - row.stiffness * way.head<3>() + turning * way;
}

double violation(const PairKinematics& at, int mode) {
  return std::hypot(at.gap, mode == contact_stick ? at.slip.norm() : 0.0);
}

}  // namespace sim_core
