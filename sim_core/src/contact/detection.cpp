#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "contact/contact_set.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::Vector4d;

// A triangle whose closest point to a vertex lies on this feature.
struct Found {
  int feature, candidate;
  Vector4d weights;
};

// Derivatives of the weights by the places of the closest points: along both edges, or along the
// sides of the feature of a triangle.
std::pair<Vector4d, Vector4d> directions(PairKind kind, const Vector4d& weights) {
  Vector4d first = Vector4d::Zero(), second = Vector4d::Zero();
  if (kind == PairKind::edge_edge) {
    first << -1.0, 1.0, 0.0, 0.0;
    second << 0.0, 0.0, 1.0, -1.0;
    return {first, second};
  }
  int base = -1;
  for (int c = 1; c < 4; ++c) {
    if (weights[c] == 0.0) continue;
    if (base < 0) {
      base = c;
      continue;
    }
    Vector4d& along = first.isZero(0.0) ? first : second;
    along[base] = 1.0;
    along[c] = -1.0;
  }
  return {first, second};
}

}  // namespace

ContactSet::ContactSet(Surface surface, const ContactMaterials& materials_in,
                       const ContactSettings& settings, const PathSettings& path, double margin,
                       int free_nodes)
    : near(std::move(surface), materials_in.farthest(), margin, path),
      materials(materials_in),
      settings_(settings),
      free_nodes_(free_nodes),
      least_distance_(std::numeric_limits<double>::infinity()),
      displacements_(near.surface.sheet_of_node.size()),
      turns_(settings.turn_max) {}

void ContactSet::begin(const Buffer<double>& start, const Buffer<double>& ends,
                       const Buffer<double>& expected, std::vector<Matrix3d> own) {
  start_ = &start;
  ends_ = &ends;
  turns_.begin(start, expected, free_nodes_);
  own_ = std::move(own);
  base_ = history_;
}

void ContactSet::find(const Buffer<double>& x) {
  std::vector<Candidate>& candidates = near.pairs(x);
  const double range = (settings_.detection_range - 1.0) * near.thickness;
  near.measure(*start_, x, displacements_);
  pairs_.clear();
  least_distance_ = std::numeric_limits<double>::infinity();
  find_vertices(candidates, range, x);
  find_edges(candidates, range, x);
}

// `range`: beyond what approached in the step, m. A vertex may be closest to an edge or corner of a
// triangle. Such a pair counts once, and only where all triangles around the feature agree: else a
// point inside one of them is closer.
void ContactSet::find_vertices(std::vector<Candidate>& candidates, double range,
                               const Buffer<double>& x) {
  const Surface& surface = near.surface;
  const int triangles = static_cast<int>(surface.triangles.size()),
            edges = static_cast<int>(surface.edges.size());
  const auto around_node = [&](int node) {
    return surface.around_begin[node + 1] - surface.around_begin[node];
  };
  const auto is_of = [&](std::size_t c, int vertex) {
    return c < candidates.size() && candidates[c].kind == PairKind::vertex_triangle &&
           candidates[c].first == vertex;
  };
  std::vector<Found> found;
  std::size_t c = 0, end = 0;
  while (c < candidates.size() && candidates[c].kind == PairKind::vertex_triangle) {
    const int vertex = candidates[c].first;
    double reach = range;
    for (; is_of(end, vertex); ++end)
      reach = std::max(reach, range + fastest(candidates[end], displacements_));
    found.clear();
    for (; c < end; ++c) {
      Candidate& stencil = candidates[c];
      if (stencil.distance > near.thickness + reach) continue;
      const FourPoints at = points_of(stencil, x);
      const Vector4d weights = closest_weights(stencil.kind, at);
      stencil.distance = between_closest(weights, at).norm();
      int corner = 0, opposite = 0;
      for (int i = 0; i < 3; ++i) (weights[1 + i] != 0.0 ? corner : opposite) = i;
      const auto corners = (weights.tail<3>().array() != 0.0).count();
      const int feature = corners == 3 ? stencil.second
                          : corners == 2
                              ? triangles + surface.triangle_edges[stencil.second][opposite]
                              : triangles + edges + stencil.node[1 + corner];
      found.push_back({feature, static_cast<int>(c), weights});
    }
    std::sort(found.begin(), found.end(), [](const Found& a, const Found& b) {
      return a.feature != b.feature ? a.feature < b.feature : a.candidate < b.candidate;
    });
    for (std::size_t i = 0, next = 0; i < found.size(); i = next) {
      const int feature = found[i].feature;
      while (next < found.size() && found[next].feature == feature) ++next;
      const int around = feature < triangles ? 1
                         : feature < triangles + edges
                             ? surface.triangles_of_edge[feature - triangles]
                             : around_node(feature - triangles - edges);
      if (static_cast<int>(next - i) != around) continue;
      const Candidate& stencil = candidates[found[i].candidate];
      if (stencil.distance > near.thickness + reach) continue;
      if (feature >= triangles + edges) {  // two corners that are each other's closest are one pair
        const int other = feature - triangles - edges;
        const auto first = std::lower_bound(
            pairs_.begin(), pairs_.end(), other,
            [](const Pair& pair, int stencil) { return pair.stencil.first < stencil; });
        if (std::any_of(first, pairs_.end(), [&](const Pair& pair) {
              return pair.stencil.first == other && pair.feature == triangles + edges + vertex;
            })) {
          continue;
        }
      }
      add(candidates[found[i].candidate], feature, found[i].weights, x);
    }
  }
}

void ContactSet::find_edges(std::vector<Candidate>& candidates, double range,
                            const Buffer<double>& x) {
  for (Candidate& stencil : candidates) {
    const double reach = near.thickness + range + fastest(stencil, displacements_);
    if (stencil.kind != PairKind::edge_edge || stencil.distance > reach) continue;
    const FourPoints at = points_of(stencil, x);
    const Vector4d weights = closest_weights(stencil.kind, at);
    stencil.distance = between_closest(weights, at).norm();
    if (stencil.distance > reach || weights.cwiseAbs().minCoeff() < settings_.end_share ||
        crossing_squared(at) < settings_.crossing_least)
      continue;
    add(stencil, stencil.second, weights, x);
  }
}

// With the compliances 1/k_i of the pair's nodes, in the mean or along n, the pair's own is sum
// w_i^2/k_i: its stiffness scales with the inverse of that.
void ContactSet::add(const Candidate& stencil, int feature, const Vector4d& weights,
                     const Buffer<double>& x) {
  const FourPoints at = points_of(stencil, x);
  const Vector3d rho = between_closest(weights, at);
  const double distance = rho.norm();
  const int a = near.surface.sheet_of_node[stencil.node[0]],
            b = near.surface.sheet_of_node[stencil.node[3]];
  least_distance_ = std::min(least_distance_, distance);
  if (!(distance > 0.0)) return;
  const auto [along_first, along_second] = directions(stencil.kind, weights);
  PairMotions given = PairMotions::Zero();
  for (int c = 0; c < 4; ++c) {
    const int node = stencil.node[c];
    if (node < free_nodes_) continue;
    const Vector3d displacement = at_node(*ends_, node) - at_node(x, node);
    given.segment<3>(0) += weights[c] * displacement;
    given.segment<3>(3) += along_first[c] * displacement;
    given.segment<3>(6) += along_second[c] * displacement;
  }
  const Vector3d n = rho / distance;
  const double share = stiff ? settings_.stiff_mean_share : settings_.mean_share;
  double softness = 0.0, softness_along = 0.0;  // m/N: in the mean, and along the normal
  for (int c = 0; c < 4; ++c) {
    if (stencil.node[c] >= free_nodes_) continue;
    const Matrix3d& own = own_[stencil.node[c]];
    const double mean = own.trace() / 3.0;
    softness += weights[c] * weights[c] / mean;
    softness_along += weights[c] * weights[c] / (share * mean + std::max(n.dot(own * n), 0.0));
  }
  if (!(softness > 0.0)) return;
  Vector3d slip = this->slip(stencil, weights, rho);
  slip -= slip.dot(n) * n;
  const double thickness = materials.rest_distance(stencil.kind, a, b),
               k = settings_.law_stiffness / softness;
  const double along =
      smoothing > 0.0 ? settings_.smooth_proximal / softness : settings_.proximal / softness_along;
  const double across =
      (smoothing > 0.0 ? settings_.smooth_proximal : settings_.proximal) / softness;
  const Vector3d first = stencil.kind == PairKind::vertex_triangle
                             ? at[0]
                             : Vector3d(weights[0] * at[0] + weights[1] * at[1]);
  pairs_.push_back({stencil,
                    feature,
                    weights,
                    {distance - thickness, n, slip, Vector3d::Zero(), materials.mu(a, b), k},
                    {along, across},
                    k * smoothing * smoothing,
                    first - 0.5 * rho,
                    thickness,
                    along_first,
                    along_second,
                    given});
}

// Motion of the first point over the second, less that by which rho turns.
Vector3d ContactSet::slip(const Candidate& stencil, const Vector4d& weights, const Vector3d& rho) {
  return rho - turn_of(stencil, weights) * between_closest(weights, points_of(stencil, *start_));
}

Matrix3d ContactSet::turn_of(const Candidate& stencil, const Vector4d& weights) {
  const std::vector<int>& sheet_of_node = near.surface.sheet_of_node;
  const int a = sheet_of_node[stencil.node[0]], b = sheet_of_node[stencil.node[3]];
  Matrix3d turn = Matrix3d::Zero();
  for (int c = 0; c < 4; ++c) {
    const int own = sheet_of_node[stencil.node[c]], other = stencil.on_first(c) ? b : a;
    const double share = own >= materials.sheets ? 1.0 : other >= materials.sheets ? 0.0 : 0.5;
    if (share * weights[c] != 0.0)
      turn += share * std::abs(weights[c]) * turns_.of(near.surface, stencil.node[c]);
  }
  return turn;
}

}  // namespace sim_core
