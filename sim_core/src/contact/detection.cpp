// Which pieces of cloth make a pair at the positions of an iterate, and the pair of each.
//
// 1. `CandidateSet::pairs` (path.cpp) lists the candidates with a lower bound of their distance.
// 2. `find_vertices` and `find_edges` measure those that may be within reach. Points that several
//    candidates have in common make one pair: a vertex over the edge of two triangles is near both.
// 3. `add` makes a pair: its gap, normal and slip, and its stiffnesses.
//
// The forces come afterwards, from the pairs of the iterate before (matching.cpp).
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
// sides of the feature of a triangle. Those of a feature with fewer sides are zero.
struct WeightDirections {
  Vector4d first = Vector4d::Zero(), second = Vector4d::Zero();
};

WeightDirections directions(PairKind kind, const Vector4d& weights) {
  WeightDirections along;
  if (kind == PairKind::edge_edge) {
    along.first << -1.0, 1.0, 0.0, 0.0;
    along.second << 0.0, 0.0, 1.0, -1.0;
    return along;
  }
  // Corners of the feature have a weight. A side leads from each further one to the first.
  int base = -1;
  for (int c = 1; c < 4; ++c) {
    if (weights[c] == 0.0) continue;
    if (base < 0) {
      base = c;
      continue;
    }
    Vector4d& side = along.first.isZero(0.0) ? along.first : along.second;
    side[base] = 1.0;
    side[c] = -1.0;
  }
  return along;
}

// Numbers of the features to which a vertex may be closest: the triangles of a surface, then its
// edges, then its nodes.
class FeatureNumbers {
 public:
  explicit FeatureNumbers(const Surface& surface)
      : edges_from_(static_cast<int>(surface.triangles.size())),
        nodes_from_(edges_from_ + static_cast<int>(surface.edges.size())) {}

  int of_edge(int edge) const { return edges_from_ + edge; }
  int of_node(int node) const { return nodes_from_ + node; }
  bool is_triangle(int feature) const { return feature < edges_from_; }
  bool is_node(int feature) const { return feature >= nodes_from_; }
  int edge(int feature) const { return feature - edges_from_; }
  int node(int feature) const { return feature - nodes_from_; }

 private:
  int edges_from_, nodes_from_;
};

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
                       const Buffer<double>& expected, std::vector<Matrix3d> own_blocks) {
  start_ = &start;
  ends_ = &ends;
  turns_.begin(start, expected, free_nodes_);
  own_blocks_ = std::move(own_blocks);
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

// The feature of a triangle that is the closest to a vertex. Its corners have a weight: three of a
// triangle, two of an edge, one of a node.
int ContactSet::feature_of(const Candidate& stencil, const Vector4d& weights) const {
  const Surface& surface = near.surface;
  const FeatureNumbers numbers(surface);
  int corner = 0, opposite = 0;  // the last with a weight, and the last without
  for (int i = 0; i < 3; ++i) (weights[1 + i] != 0.0 ? corner : opposite) = i;
  const auto corners = (weights.tail<3>().array() != 0.0).count();
  if (corners == 3) return stencil.second;
  if (corners == 2) return numbers.of_edge(surface.triangle_edges[stencil.second][opposite]);
  return numbers.of_node(stencil.node[1 + corner]);
}

// How many triangles have a feature in common.
int ContactSet::triangles_around(int feature) const {
  const Surface& surface = near.surface;
  const FeatureNumbers numbers(surface);
  if (numbers.is_triangle(feature)) return 1;
  if (!numbers.is_node(feature)) return surface.triangles_of_edge[numbers.edge(feature)];
  const int node = numbers.node(feature);
  return surface.around_begin[node + 1] - surface.around_begin[node];
}

// Whether the pair of a vertex and a node is in the list already, as that of the node and the
// vertex: two nodes that are each other's closest make one pair.
bool ContactSet::has_reverse(int vertex, int feature) const {
  const FeatureNumbers numbers(near.surface);
  if (!numbers.is_node(feature)) return false;
  const int node = numbers.node(feature);
  // Pairs of vertices are sorted by the vertex.
  const auto first_of_node =
      std::lower_bound(pairs_.begin(), pairs_.end(), node,
                       [](const Pair& pair, int first) { return pair.stencil.first < first; });
  return std::any_of(first_of_node, pairs_.end(), [&](const Pair& pair) {
    return pair.stencil.first == node && pair.feature == numbers.of_node(vertex);
  });
}

// `range`: distance up to which pieces make a pair, beside what they keep apart and what they may
// have approached in the step, m. The candidates of a vertex follow each other.
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
// `NearFeature` tells which feature each triangle names.
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
  // Triangles that name the same feature follow each other now.
  for (std::size_t i = 0, next = 0; i < near_features.size(); i = next) {
    const int feature = near_features[i].feature;
    while (next < near_features.size() && near_features[next].feature == feature) ++next;
    const Candidate& stencil = *near_features[i].candidate;
    const bool do_all_agree = static_cast<int>(next - i) == triangles_around(feature);
    if (!do_all_agree || stencil.distance > reach || has_reverse(stencil.first, feature)) continue;
    add(stencil, feature, near_features[i].weights, x);
  }
}

// Two edges make a pair where they cross. Their ends belong to vertices, and parallel edges have no
// unique closest points.
void ContactSet::find_edges(std::vector<Candidate>& candidates, double range,
                            const Buffer<double>& x) {
  for (Candidate& stencil : candidates) {
    const double reach = near.thickness + range + fastest(stencil, displacements_);
    if (stencil.kind != PairKind::edge_edge || stencil.distance > reach) continue;
    const FourPoints at = points_of(stencil, x);
    const Vector4d weights = closest_weights(stencil.kind, at);
    stencil.distance = between_closest(weights, at).norm();
    const bool is_at_an_end = weights.cwiseAbs().minCoeff() < end_weight;
    if (stencil.distance > reach || is_at_an_end || crossing_squared(at) < pairs::crossing_min)
      continue;
    add(stencil, stencil.second, weights, x);
  }
}

// Compliances of the free nodes of a pair: with the stiffness K_i of a node, in the mean or along
// n, that of the pair is sum w_i^2/K_i. Both are 0 where all nodes are held.
ContactSet::Compliance ContactSet::compliance(const Candidate& stencil, const Vector4d& weights,
                                              const Vector3d& normal) const {
  const double mean_fraction = stiff ? 1.0 : stiffness::mean_fraction;
  Compliance sum{0.0, 0.0};
  for (int c = 0; c < 4; ++c) {
    if (stencil.node[c] >= free_nodes_) continue;
    const Matrix3d& node_stiffness = own_blocks_[stencil.node[c]];
    const double mean = node_stiffness.trace() / 3.0;
    const double along_normal =
        mean_fraction * mean + std::max(normal.dot(node_stiffness * normal), 0.0);
    sum.mean += weights[c] * weights[c] / mean;
    sum.along_normal += weights[c] * weights[c] / along_normal;
  }
  return sum;
}

// The proximal stiffness of a pair. The smoothed law regularizes redundant pairs by itself.
ProximalStiffness ContactSet::proximal_stiffness(const Compliance& compliance) const {
  if (smoothing > 0.0) {
    const double smoothed = stiffness::smoothed_proximal / compliance.mean;
    return {.normal = smoothed, .tangential = smoothed};
  }
  return {.normal = stiffness::proximal / compliance.along_normal,
          .tangential = stiffness::proximal / compliance.mean};
}

// The part of a pair's motions that its held nodes still have to make: from x to their ends.
PairMotions ContactSet::held_motions(const Candidate& stencil, const Vector4d& weights,
                                     const Vector4d& along_first, const Vector4d& along_second,
                                     const Buffer<double>& x) const {
  PairMotions motions = PairMotions::Zero();
  for (int c = 0; c < 4; ++c) {
    const int node = stencil.node[c];
    if (node < free_nodes_) continue;
    const Vector3d displacement = at_node(*ends_, node) - at_node(x, node);
    motions.segment<3>(0) += weights[c] * displacement;
    motions.segment<3>(3) += along_first[c] * displacement;
    motions.segment<3>(6) += along_second[c] * displacement;
  }
  return motions;
}

// Adds the pair of a candidate, without a force.
void ContactSet::add(const Candidate& stencil, int feature, const Vector4d& weights,
                     const Buffer<double>& x) {
  const FourPoints at = points_of(stencil, x);
  const Vector3d rho = between_closest(weights, at);
  const double distance = rho.norm();
  least_distance_ = std::min(least_distance_, distance);
  // Points that coincide have no normal.
  if (!(distance > 0.0)) return;
  const Vector3d n = rho / distance;
  const Compliance softness = compliance(stencil, weights, n);
  // Held nodes move as they must, whatever force acts on them.
  if (!(softness.mean > 0.0)) return;

  const int first_sheet = near.surface.sheet_of_node[stencil.node[0]];
  const int second_sheet = near.surface.sheet_of_node[stencil.node[3]];
  const double thickness = materials.rest_distance(stencil.kind, first_sheet, second_sheet);
  Vector3d slip = this->slip(stencil, weights, rho);
  slip -= slip.dot(n) * n;
  const double k = stiffness::law / softness.mean;
  const Contact contact{.gap = distance - thickness,
                        .normal = n,
                        .slip = slip,
                        .force = Vector3d::Zero(),
                        .mu = materials.mu(first_sheet, second_sheet),
                        .stiffness = k};
  const Vector3d first_point = stencil.kind == PairKind::vertex_triangle
                                   ? at[0]
                                   : Vector3d(weights[0] * at[0] + weights[1] * at[1]);
  const auto [along_first, along_second] = directions(stencil.kind, weights);
  pairs_.push_back({.stencil = stencil,
                    .feature = feature,
                    .weights = weights,
                    .contact = contact,
                    .proximal = proximal_stiffness(softness),
                    .smoothing_energy = k * smoothing * smoothing,
                    .middle = first_point - 0.5 * rho,
                    .thickness = thickness,
                    .along_first = along_first,
                    .along_second = along_second,
                    .held_motions = held_motions(stencil, weights, along_first, along_second, x)});
}

// Motion of the first point over the second, less that by which rho turns.
Vector3d ContactSet::slip(const Candidate& stencil, const Vector4d& weights, const Vector3d& rho) {
  return rho - turn_of(stencil, weights) * between_closest(weights, points_of(stencil, *start_));
}

// The turn of a pair's nodes by their weights: half of it from each of two sheets, and all of it
// from a surface, which sheets do not turn.
Matrix3d ContactSet::turn_of(const Candidate& stencil, const Vector4d& weights) {
  const std::vector<int>& sheet_of_node = near.surface.sheet_of_node;
  const int first_sheet = sheet_of_node[stencil.node[0]];
  const int second_sheet = sheet_of_node[stencil.node[3]];
  const auto is_surface = [&](int sheet) { return sheet >= materials.sheets; };
  Matrix3d turn = Matrix3d::Zero();
  for (int c = 0; c < 4; ++c) {
    const int sheet = sheet_of_node[stencil.node[c]];
    const int opposite_sheet = stencil.on_first(c) ? second_sheet : first_sheet;
    const double fraction = is_surface(sheet) ? 1.0 : is_surface(opposite_sheet) ? 0.0 : 0.5;
    if (fraction * weights[c] != 0.0)
      turn += fraction * std::abs(weights[c]) * turns_.of(near.surface, stencil.node[c]);
  }
  return turn;
}

}  // namespace sim_core
