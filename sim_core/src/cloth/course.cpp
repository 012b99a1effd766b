#include "cloth/course.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "cloth/refusal.hpp"

namespace sim_core {
namespace {

using Eigen::Array3d;
using Eigen::Vector3d;

// A ball around the cloth.
struct Around {
  Vector3d middle;
  double radius;
};

Around around(const Stepper& stepper) {
  const Numbering& numbering = stepper.numbering();
  Eigen::AlignedBox3d box;
  for (int i = 0; i < numbering.vertices; ++i) box.extend(at_node(stepper.x, numbering.node[i]));
  return {0.5 * (box.min() + box.max()), 0.5 * box.diagonal().norm()};
}

// Distance of a body's material points near the cloth from where they are taken to be: that of their middle, and what
// the turn adds over their radius. None where the cloth is further away than it is wide.
double apart(const Body& now, const Body& even, const Around& cloth) {
  if (std::min(gap_of(now, cloth.middle).distance, gap_of(even, cloth.middle).distance) > 2.0 * cloth.radius)
    return 0.0;
  Array3d extent = now.core.array() + now.radius;
  if (now.shape == Body::plane) extent.setConstant(HUGE_VAL);
  const Array3d middle = (even.rotation.transpose() * (cloth.middle - even.origin)).array();
  const Array3d low = (middle - cloth.radius).max(-extent).min(extent);
  const Array3d high = (middle + cloth.radius).min(extent).max(-extent);
  const Vector3d at = 0.5 * (low + high).matrix();
  const double reach = std::min(0.5 * (high - low).matrix().norm(), cloth.radius);
  const Vector3d way = now.origin + now.rotation * at - even.origin - even.rotation * at;
  return way.norm() + reach * (now.rotation - even.rotation).norm() / std::sqrt(2.0);
}

}  // namespace

void Course::look(double begin, double end, int looks, const Path& path) {
  constexpr double golden = 0.6180339887498949, scatter = 0.2;
  times_.clear();
  for (int k = 0; k < looks; ++k) {
    const double place = 0.5 + scatter * (golden * k - std::floor(golden * k) - 0.5);
    times_.push_back(begin + (end - begin) * (k + place) / looks);
  }
  track_ = path(times_);
  if (!track_.points.allFinite() || !track_.poses.allFinite()) {
    refuse(text("motion: must be finite, and is not between ", begin, " and ", end, " s"));
  }
}

double Course::off(double begin, double end, const Stepper& stepper, const Drive& drive) const {
  const Numbering& numbering = stepper.numbering();
  const std::vector<Body>& before = stepper.bodies();
  const Eigen::Index held = drive.held.rows(), points = held + drive.others.rows();
  const auto count = static_cast<Eigen::Index>(drive.bodies.size()), times = static_cast<Eigen::Index>(times_.size());
  if (track_.points.rows() != times * points || track_.poses.rows() != 3 * times * count) {
    refuse("motion: held vertices, surfaces and bodies must keep their number");
  }
  if (held != static_cast<Eigen::Index>(numbering.held.size()) || before.size() != drive.bodies.size()) return 0.0;
  const Around cloth = around(stepper);
  double out = 0.0;
  for (Eigen::Index t = 0; t < times; ++t) {
    const double share = (times_[t] - begin) / (end - begin);
    if (!(share > 0.0 && share < 1.0)) continue;
    for (Eigen::Index p = 0; p < points; ++p) {
      const int node = p < held ? numbering.held[p] : numbering.node[numbering.vertices + p - held];
      const Vector3d from = at_node(stepper.x, node);
      const Vector3d to = (p < held ? drive.held.row(p) : drive.others.row(p - held)).transpose();
      out = std::max(out, (track_.points.row(t * points + p).transpose() - from - share * (to - from)).norm());
    }
    for (Eigen::Index b = 0; b < count; ++b) {
      const auto pose = track_.poses.middleRows<3>(3 * (t * count + b));
      Body now = drive.bodies[b];
      now.rotation = pose.leftCols<3>();
      now.origin = pose.col(3);
      out = std::max(out, apart(now, between(before[b], drive.bodies[b], share), cloth));
    }
  }
  return out;
}

}  // namespace sim_core
