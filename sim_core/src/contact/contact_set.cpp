#include "contact/contact_set.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>

#include "contact/constants.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::Vector4d;

// How the closest points move over their pieces, and how the normal turns, by a pair's motions m,
// m_1, m_2: they lie where rho is across the directions a_k = sum w_ki x_i, so that
//
//     sum_l a_k . a_l dtheta_l = -(a_k . m + rho . m_k),   dn = (1 - n n^T) (m + sum a_k
//     dtheta_k)/d.
void turn(Pair& pair, const Buffer<double>& x) {
  pair.sliding.setZero();
  pair.force_by_motions.setZero();
  if (!pair.active() || pair.contact.force.isZero(0.0)) return;
  const FourPoints at = points_of(pair.stencil, x);
  const int count =
      (pair.along_first.isZero(0.0) ? 0 : 1) + (pair.along_second.isZero(0.0) ? 0 : 1);
  const double distance = pair.contact.gap + pair.thickness;
  const Vector3d n = pair.contact.normal, rho = distance * n;
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
  Eigen::Matrix<double, 3, 9> displacement = a * pair.sliding;
  displacement.leftCols<3>() += Matrix3d::Identity();
  pair.force_by_motions =
      pair.row.force_by_normal * (displacement - n * (n.transpose() * displacement)) / distance;
}

}  // namespace

void PairArrays::clear() {
  nodes_.clear();
  weights_.clear();
  stiffness_.clear();
}

void PairArrays::add(const Pair& pair, int free_nodes) {
  for (int node : pair.stencil.node) nodes_.push_back(node < free_nodes ? node : -1);
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

PairData PairArrays::data() const {
  return {static_cast<int>(nodes_.size() / 4), nodes_.data(), weights_.data(), stiffness_.data()};
}

PairPast::PairPast(const Pair& pair)
    : stencil(pair.stencil),
      feature(pair.feature),
      mode(pair.row.mode),
      force(pair.contact.force),
      change(pair.change),
      normal(pair.contact.normal),
      middle(pair.middle),
      thickness(pair.thickness),
      proximal_growth(pair.proximal_growth),
      missed(violation(pair.contact, pair.row.mode)),
      cone(pair.cone) {}

PairMotions Pair::motions(const Buffer<float>& change, int free_nodes) const {
  PairMotions out = held_motions;
  for (int c = 0; c < 4; ++c) {
    if (stencil.node[c] >= free_nodes) continue;
    const Vector3d displacement = at_node(change, stencil.node[c]).cast<double>();
    out.segment<3>(0) += weights[c] * displacement;
    out.segment<3>(3) += along_first[c] * displacement;
    out.segment<3>(6) += along_second[c] * displacement;
  }
  return out;
}

Eigen::Matrix<double, 9, 9> Pair::stiffness() const {
  Eigen::Matrix<double, 9, 9> out;
  out.topRows<3>() = -force_by_motions;
  out.topLeftCorner<3, 3>() += row.stiffness;
  out.middleRows<3>(3) = -contact.force * sliding.row(0);
  out.bottomRows<3>() = -contact.force * sliding.row(1);
  return out;
}

Vector3d Pair::motion(const Buffer<float>& change, int free_nodes) const {
  Vector3d out = held_motions.head<3>();
  for (int c = 0; c < 4; ++c) {
    if (stencil.node[c] < free_nodes)
      out += weights[c] * at_node(change, stencil.node[c]).cast<double>();
  }
  return out;
}

Vector3d Pair::force_change(const Buffer<float>& change, int free_nodes) const {
  const PairMotions displacement = motions(change, free_nodes);
  return row.force - row.stiffness * displacement.head<3>() + force_by_motions * displacement;
}

LawResponse Pair::law() const {
  return smoothing_energy > 0.0 ? smoothed_law(contact, smoothing_energy) : coulomb_law(contact);
}

double violation(const Contact& contact, int mode) {
  return std::hypot(contact.gap, mode == contact_stick ? contact.slip.norm() : 0.0);
}

void ContactSet::restart() {
  history_.clear();
  pairs_.clear();
}

void ContactSet::store_history() {
  history_.clear();
  for (const Pair& pair : pairs_) {
    if (pair.contact.force.isZero(0.0)) continue;
    history_.emplace_back(pair);
    history_.back().change.setZero();
    history_.back().proximal_growth = 1.0;
    if (has_static_) history_.back().cone = cone_after(pair.row.mode);
  }
  if (has_static_) ended_ = history_;
}

void ContactSet::update(const Buffer<double>& x, double step_length, Buffer<double>& residual) {
  find(x);
  transfer(step_length);
  merge();
  if (has_static_) choose_cones();
  linearize_at(x);
  for (const Pair& pair : pairs_) {
    if (pair.contact.force.isZero(0.0)) continue;
    for (int c = 0; c < 4; ++c)
      at_node(residual, pair.stencil.node[c]) -= pair.weights[c] * pair.contact.force;
  }
}

void ContactSet::add_stiffness(double fraction, std::vector<double>& stiffness) const {
  for (const Pair& pair : pairs_) {
    if (!pair.active()) continue;
    const double pair_stiffness =
        fraction * pair.row.symmetric.trace() / (3.0 * pair.proximal_growth);
    for (int c = 0; c < 4; ++c) {
      if (pair.stencil.node[c] < free_nodes_)
        stiffness[pair.stencil.node[c]] += pair.weights[c] * pair.weights[c] * pair_stiffness;
    }
  }
}

void ContactSet::count_errors(double stiffness, ForceNorms& norms) const {
  for (const Pair& pair : pairs_) {
    Contact contact = pair.contact;
    contact.stiffness = stiffness;
    const double error = missed_squared(contact, pair.smoothing_energy);
    if (error != 0.0) norms.count(error);
  }
}

bool ContactSet::relevant() const {
  const std::vector<int>& sheet_of_node = near.surface.sheet_of_node;
  return std::any_of(pairs_.begin(), pairs_.end(), [&](const Pair& pair) {
    const int last =
        std::max(sheet_of_node[pair.stencil.node[0]], sheet_of_node[pair.stencil.node[3]]);
    return pair.active() || last < materials.sheets;
  });
}

bool ContactSet::active() const {
  return std::any_of(pairs_.begin(), pairs_.end(), [](const Pair& pair) {
    return pair.active() || !pair.contact.force.isZero(0.0);
  });
}

double ContactSet::smoothed_force() const {
  double sum = 0.0;
  for (const Pair& pair : pairs_) sum += pair.contact.stiffness;
  return pairs_.empty() ? 0.0 : smoothing * sum / static_cast<double>(pairs_.size());
}

void ContactSet::solved(const Buffer<float>& change) {
  for (Pair& pair : pairs_) {
    pair.change = pair.force_change(change, free_nodes_);
    pair.added = pair.released = false;
  }
  base_.assign(pairs_.begin(), pairs_.end());
}

void ContactSet::return_to_best() {
  base_ = best_;
  for (PairPast& pair : base_) pair.change.setZero();
}

bool ContactSet::warm_start() {
  bool any = false;
  for (Pair& pair : pairs_) {
    if (pair.active() || pair.contact.force.isZero(0.0) ||
        pair.contact.gap > pairs::closing_gap * pair.thickness)
      continue;
    Contact touching = pair.contact;
    touching.gap = 0.0;
    const LawResponse law = coulomb_law(touching);
    if (law.mode == contact_open) continue;
    pair.row = pair_row(touching, law, pair.proximal);
    pair.row.force -= pair.row.stiffness * pair.contact.gap * pair.contact.normal;
    any = true;
  }
  return any;
}

bool ContactSet::activate(const Buffer<float>& change) {
  bool changed = false;
  for (Pair& pair : pairs_) {
    if (!pair.added) continue;
    const Vector3d force = pair.contact.force + pair.force_change(change, free_nodes_);
    if (force.dot(pair.contact.normal) >= 0.0) continue;
    pair.row = pair_row(pair.contact, {}, pair.proximal);  // open
    pair.force_by_motions.setZero();
    pair.sliding.setZero();
    pair.added = false;
    pair.released = changed = true;
  }
  for (PairKind kind : {PairKind::vertex_triangle, PairKind::edge_edge}) {
    bool any = false;
    for (Pair& pair : pairs_) {
      if (pair.stencil.kind != kind || pair.active() || pair.released) continue;
      const Vector3d motion = pair.motion(change, free_nodes_);
      if (!(pair.contact.gap + pair.contact.normal.dot(motion) <
            -pairs::closing_gap * pair.thickness))
        continue;
      pair.row = pair_row(pair.contact, closing(pair.contact, motion), pair.proximal);
      pair.added = any = true;
    }
    if (any) return true;
  }
  return changed;
}

void ContactSet::linearize_at(const Buffer<double>& x) {
  for (Pair& pair : pairs_) {
    pair.row = pair_row(pair.contact, pair.law(), pair.proximal);
    turn(pair, x);
  }
}

PairData ContactSet::rows() {
  rows_.clear();
  for (const Pair& pair : pairs_) {
    if (pair.active()) rows_.add(pair, free_nodes_);
  }
  return rows_.data();
}

void ContactSet::subtract_right_side(Buffer<float>& force) const {
  for (const Pair& pair : pairs_) {
    PairMotions change = -pair.stiffness() * pair.held_motions;
    change.head<3>() += pair.row.force;
    if (change.isZero(0.0)) continue;
    for (int c = 0; c < 4; ++c) {
      if (pair.stencil.node[c] >= free_nodes_) continue;
      at_node(force, pair.stencil.node[c]) -=
          (pair.weights[c] * change.segment<3>(0) + pair.along_first[c] * change.segment<3>(3) +
           pair.along_second[c] * change.segment<3>(6))
              .cast<float>();
    }
  }
}

}  // namespace sim_core
