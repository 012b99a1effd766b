#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "contact/constants.hpp"
#include "contact/contact_set.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::Vector4d;

// Share of the length of an edge, from its ends, within which it makes no pair: the vertex does.
// Far above rounding, far below what moves a force.
constexpr double end_weight = 1e-3;

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

ContactSet::ContactSet(Surface surface, const ContactMaterials& materials_in, double skin,
                       int free_nodes)
    : near(std::move(surface), materials_in.farthest(), skin),
      materials(materials_in),
      free_nodes_(free_nodes),
      least_distance_(std::numeric_limits<double>::infinity()),
      displacements_(near.surface.sheet_of_node.size()),
      has_static_(materials_in.has_static()) {}

void ContactSet::begin(const Buffer<double>& start, const Buffer<double>& ends,
                       const Buffer<double>& expected, std::vector<Matrix3d> own) {
  start_ = &start;
  ends_ = &ends;
  turns_.begin(start, expected, free_nodes_);
  own_ = std::move(own);
  base_ = history_;
  if (has_static_) expected_ = expected;
}

void ContactSet::find(const Buffer<double>& x) {
  std::vector<Candidate>& candidates = near.pairs(x);
  const double range = (pairs::detection_range - 1.0) * near.thickness;
  near.measure(*start_, x, displacements_);
  pairs_.clear();
  least_distance_ = std::numeric_limits<double>::infinity();
  find_vertices(candidates, range, x);
  find_edges(candidates, range, x);
}

// Which feature of a triangle is the closest to a vertex: see Pair.
int ContactSet::feature_of(const Candidate& stencil, const Vector4d& weights) const {
  const Surface& surface = near.surface;
  const int triangles = static_cast<int>(surface.triangles.size());
  int corner = 0, opposite = 0;
  for (int i = 0; i < 3; ++i) (weights[1 + i] != 0.0 ? corner : opposite) = i;
  const auto corners = (weights.tail<3>().array() != 0.0).count();
  if (corners == 3) return stencil.second;
  if (corners == 2) return triangles + surface.triangle_edges[stencil.second][opposite];
  return triangles + static_cast<int>(surface.edges.size()) + stencil.node[1 + corner];
}

int ContactSet::triangles_around(int feature) const {
  const Surface& surface = near.surface;
  const int triangles = static_cast<int>(surface.triangles.size());
  const int edges = static_cast<int>(surface.edges.size());
  if (feature < triangles) return 1;
  if (feature < triangles + edges) return surface.triangles_of_edge[feature - triangles];
  const int node = feature - triangles - edges;
  return surface.around_begin[node + 1] - surface.around_begin[node];
}

// Two corners that are each other's closest are one pair.
bool ContactSet::has_reverse(int vertex, int feature) const {
  const int nodes_from =
      static_cast<int>(near.surface.triangles.size() + near.surface.edges.size());
  if (feature < nodes_from) return false;
  const int other = feature - nodes_from;
  const auto first =
      std::lower_bound(pairs_.begin(), pairs_.end(), other,
                       [](const Pair& pair, int stencil) { return pair.stencil.first < stencil; });
  return std::any_of(first, pairs_.end(), [&](const Pair& pair) {
    return pair.stencil.first == other && pair.feature == nodes_from + vertex;
  });
}

// `range`: beyond what approached in the step, m. The candidates of a vertex follow each other.
void ContactSet::find_vertices(std::vector<Candidate>& candidates, double range,
                               const Buffer<double>& x) {
  std::size_t begin = 0;
  while (begin < candidates.size() && candidates[begin].kind == PairKind::vertex_triangle) {
    const int vertex = candidates[begin].first;
    std::size_t end = begin;
    double reach = range;
    for (; end < candidates.size() && candidates[end].kind == PairKind::vertex_triangle &&
           candidates[end].first == vertex;
         ++end) {
      reach = std::max(reach, range + fastest(candidates[end], displacements_));
    }
    find_vertex({candidates.data() + begin, end - begin}, near.thickness + reach, x);
    begin = end;
  }
}

// A vertex may be closest to an edge or corner of a triangle. Such a pair counts once, and only
// where all triangles around the feature agree: else a point inside one of them is closer.
void ContactSet::find_vertex(std::span<Candidate> candidates, double reach,
                             const Buffer<double>& x) {
  std::vector<NearFeature>& near_features = near_features_;
  near_features.clear();
  for (Candidate& stencil : candidates) {
    if (stencil.distance > reach) continue;
    const FourPoints at = points_of(stencil, x);
    const Vector4d weights = closest_weights(stencil.kind, at);
    stencil.distance = between_closest(weights, at).norm();
    near_features.push_back({feature_of(stencil, weights), &stencil, weights});
  }
  std::sort(near_features.begin(), near_features.end(),
            [](const NearFeature& a, const NearFeature& b) {
              return a.feature != b.feature ? a.feature < b.feature : a.candidate < b.candidate;
            });
  for (std::size_t i = 0, next = 0; i < near_features.size(); i = next) {
    const int feature = near_features[i].feature;
    while (next < near_features.size() && near_features[next].feature == feature) ++next;
    const Candidate& stencil = *near_features[i].candidate;
    const bool agree = static_cast<int>(next - i) == triangles_around(feature);
    if (!agree || stencil.distance > reach || has_reverse(stencil.first, feature)) continue;
    add(stencil, feature, near_features[i].weights, x);
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
    if (stencil.distance > reach || weights.cwiseAbs().minCoeff() < end_weight ||
        crossing_squared(at) < pairs::crossing_min)
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
  const double mean_fraction = stiff ? 1.0 : stiffness::mean_fraction;
  double softness = 0.0, softness_along = 0.0;  // m/N: in the mean, and along the normal
  for (int c = 0; c < 4; ++c) {
    if (stencil.node[c] >= free_nodes_) continue;
    const Matrix3d& own = own_[stencil.node[c]];
    const double mean = own.trace() / 3.0;
    softness += weights[c] * weights[c] / mean;
    softness_along +=
        weights[c] * weights[c] / (mean_fraction * mean + std::max(n.dot(own * n), 0.0));
  }
  if (!(softness > 0.0)) return;
  Vector3d slip = this->slip(stencil, weights, rho);
  slip -= slip.dot(n) * n;
  const double thickness = materials.rest_distance(stencil.kind, a, b),
               k = stiffness::law / softness;
  const double along = smoothing > 0.0 ? stiffness::smoothed_proximal / softness
                                       : stiffness::proximal / softness_along;
  const double across =
      (smoothing > 0.0 ? stiffness::smoothed_proximal : stiffness::proximal) / softness;
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
    const double fraction = own >= materials.sheets ? 1.0 : other >= materials.sheets ? 0.0 : 0.5;
    if (fraction * weights[c] != 0.0)
      turn += fraction * std::abs(weights[c]) * turns_.of(near.surface, stencil.node[c]);
  }
  return turn;
}

}  // namespace sim_core
