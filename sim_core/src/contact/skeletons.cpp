#include "contact/skeletons.hpp"

#include <algorithm>
#include <cmath>

namespace sim_core {
namespace {

using Eigen::Vector3d;

// Where the box from `low` to `high` lies along an axis.
std::array<double, 2> range_along(const Vector3d& axis, const Vector3d& origin, const Vector3d& low,
                                  const Vector3d& high) {
  const double middle = axis.dot(0.5 * (low + high) - origin), half = axis.cwiseAbs().dot(0.5 * (high - low));
  return {middle - half, middle + half};
}

// Corners of the core: bit `a` of a corner's number says on which side of axis `a` it lies, where the core has one.
Skeleton skeleton_of(const std::array<std::array<double, 2>, 3>& core, bool whole) {
  Skeleton out{};
  std::vector<int> axes;
  for (int a = 0; a < 3; ++a) {
    if (core[a][0] < core[a][1]) axes.push_back(a);
  }
  const int count = 1 << axes.size();
  for (int corner = 0; corner < count; ++corner) {
    Vector3d p(core[0][0], core[1][0], core[2][0]);
    for (std::size_t k = 0; k < axes.size(); ++k) p[axes[k]] = core[axes[k]][corner >> k & 1];
    out.points.push_back(p);
  }
  const int all = static_cast<int>(axes.size());
  for (int corner = 0; corner < count; ++corner) {
    for (int k = 0; k < all; ++k) {
      if (corner >> k & 1) continue;
      const int next = corner | 1 << k;
      out.segments.push_back({corner, next});
      if (whole && all == 1) out.triangles.push_back({corner, next, next});
      for (int l = k + 1; whole && l < all; ++l) {
        if (corner >> l & 1) continue;
        const int other = corner | 1 << l, opposite = next | other;
        out.triangles.push_back({corner, next, opposite});
        out.triangles.push_back({corner, opposite, other});
      }
    }
  }
  return out;
}

}  // namespace

std::vector<Skeleton> skeletons_of(const std::vector<Body>& bodies, double cell, const Vector3d& low,
                                   const Vector3d& high, double beyond, const SkeletonSettings& settings) {
  std::vector<Skeleton> out;
  for (std::size_t b = 0; b < bodies.size(); ++b) {
    const Body& body = bodies[b];
    if (body.shape == Body::plane || body.radius >= settings.radius_max * cell) continue;
    std::array<std::array<double, 2>, 3> core;
    for (int a = 0; a < 3; ++a) {
      core[a] = {-body.core[a], body.core[a]};
      if (std::isfinite(body.core[a])) continue;
      core[a] = range_along(body.rotation.col(a), body.origin, low, high);
      core[a][0] -= beyond;
      core[a][1] += beyond;
    }
    const bool whole = body.core.minCoeff() + body.radius < settings.thickness_max * cell;
    Skeleton one = skeleton_of(core, whole);
    one.body = static_cast<int>(b);
    one.radius = body.radius;
    one.whole = whole;
    out.push_back(std::move(one));
  }
  return out;
}

}  // namespace sim_core
