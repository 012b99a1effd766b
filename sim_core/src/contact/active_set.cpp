#include "contact/contact_set.hpp"

namespace sim_core {

using Eigen::Matrix3d;
using Eigen::Vector3d;

bool ContactSet::resume() {
  bool any = false;
  for (Pair& pair : pairs_) {
    if (pair.active() || pair.at.force.isZero(0.0) || pair.at.gap > settings_.closing_gap * pair.scale) continue;
    PairKinematics touching = pair.at;
    touching.gap = 0.0;
    const PairLinearization row = linearize(touching);
    if (row.mode == contact_open) continue;
    pair.row = row;
    pair.row.force -= row.stiffness * pair.at.gap * pair.at.normal;
    any = true;
  }
  return any;
}

bool ContactSet::activate(const Buffer<float>& change) {
  bool changed = false;
  for (Pair& pair : pairs_) {
    if (!pair.added) continue;
    const Vector3d force = pair.at.force + pair.force_change(change, free_nodes_);
    if (force.dot(pair.at.normal) >= 0.0) continue;
    pair.row = {contact_open, Matrix3d::Zero(), Matrix3d::Zero(), -pair.at.force};
    pair.turning.setZero();
    pair.sliding.setZero();
    pair.added = false;
    pair.released = changed = true;
  }
  for (PairKind kind : {PairKind::vertex_triangle, PairKind::edge_edge}) {
    bool any = false;
    for (Pair& pair : pairs_) {
      if (pair.who.kind != kind || pair.active() || pair.released) continue;
      const Vector3d motion = pair.motion(change, free_nodes_);
      if (!(pair.at.gap + pair.at.normal.dot(motion) < -settings_.closing_gap * pair.scale)) continue;
      pair.row = linearize_closing(pair.at, motion);
      pair.added = any = true;
    }
    if (any) return true;
  }
  return changed;
}

}  // namespace sim_core
