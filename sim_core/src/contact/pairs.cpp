#include "contact/pairs.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <tuple>
#include <utility>

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;
using Eigen::Vector4d;
using Motions = Eigen::Matrix<double, 9, 1>;

// Stiffness of the law, and of the proximal term, over that of a pair's nodes.
constexpr double law_share = 0.1, proximal_share = 10.0, smooth_proximal_share = 1000.0;
// Along the normal a node counts with its stiffness there and a share of its mean one. Cloth is much stiffer in its
// plane than across it: with the mean alone, pairs that contradict each other by rounding trade large forces.
constexpr double mean_share = 0.2, stiff_mean_share = 1.0;
// A pair whose predicted gap is below minus so much of the thickness is made to bear, and one that bore at the end of
// the last step bears on up to so much.
constexpr double predicted_gap = 0.02;
// Edges whose squared sine is smaller have no pair, nor have those that are closest nearer to an end than so much of
// their length: vertices have one there.
constexpr double crossing_least = 0.01, end_share = 1e-3;
// Cosine up to which a force is handed on from one normal to another.
constexpr double hand_on_cosine = 0.5;
// Pairs that say nearly the same but contradict each other trade forces until one lets go. A pair whose gap or slip
// stays above this share of what it was, between `insist_from` [m] and a share of the thickness, gets a larger proximal
// stiffness: by so much, up to so much in all.
constexpr double insist_above = 0.5, insist_from = 2e-9, insist_up_to = 0.5, insist_more = 4.0, insist_max = 1024.0;
// Pairs whose middles are nearer than so much of the thickness are one; forces are handed on up to so far.
constexpr double merge_share = 0.2, hand_on_share = 0.5;
// Pieces further apart than so many thicknesses, and what they may have come towards each other in this step, are no
// pair.
constexpr double near_share = 2.0;

template <class Any>
auto key(const Any& pair) {
  return std::make_tuple(pair.who.kind, pair.who.first, pair.feature);
}

// How the closest points move over their pieces, and how the normal turns, by a pair's motions m, m_1, m_2: they lie
// where rho is across the directions a_k = sum w_ki x_i, so that
//
//     sum_l a_k . a_l dtheta_l = -(a_k . m + rho . m_k),   dn = (1 - n n^T) (m + sum a_k dtheta_k)/d.
void turn(Pair& pair, const Buffer<double>& x) {
  pair.sliding.setZero();
  pair.turning.setZero();
  if (!pair.bears() || pair.sight.force.isZero(0.0)) return;
  const FourPoints at = points_of(pair.who, x);
  const int count = (pair.along_first.isZero(0.0) ? 0 : 1) + (pair.along_second.isZero(0.0) ? 0 : 1);
  const double distance = pair.sight.gap + pair.thickness;
  const Vector3d n = pair.sight.normal, rho = distance * n;
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

// By how much a pair that bears misses what its row asks for, m.
double missed(const PairSight& sight, int mode) {
  return std::hypot(sight.gap, mode == contact_stick ? sight.slip.norm() : 0.0);
}

}  // namespace

PairPast::PairPast(const Pair& pair)
    : who(pair.who),
      feature(pair.feature),
      mode(pair.row.mode),
      force(pair.sight.force),
      change(pair.change),
      normal(pair.sight.normal),
      middle(pair.middle),
      thickness(pair.thickness),
      insistence(pair.insistence),
      missed(sim_core::missed(pair.sight, pair.row.mode)) {}

Motions Pair::motions(const Buffer<float>& change, int free_nodes) const {
  Motions out = given;
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
  out.middleRows<3>(3) = -sight.force * sliding.row(0);
  out.bottomRows<3>() = -sight.force * sliding.row(1);
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
  const Motions way = motions(change, free_nodes);
  return row.force - row.stiffness * way.head<3>() + turning * way;
}

Pairs::Pairs(Surface surface, const PairSettings& settings, double margin, int free_nodes)
    : near(std::move(surface), settings.farthest(), margin),
      settings_(settings),
      free_nodes_(free_nodes),
      least_distance_(std::numeric_limits<double>::infinity()) {}

void Pairs::restart() {
  kept_.clear();
  pairs_.clear();
}

void Pairs::begin(const Buffer<double>& start, const Buffer<double>& ends, const Buffer<double>& expected,
                  std::vector<Matrix3d> own) {
  start_ = &start;
  ends_ = &ends;
  turns_.begin(start, expected, free_nodes_);
  own_ = std::move(own);
  base_ = kept_;
}

void Pairs::keep() {
  kept_.clear();
  for (const Pair& pair : pairs_) {
    if (pair.sight.force.isZero(0.0)) continue;
    kept_.emplace_back(pair);
    kept_.back().change.setZero();
    kept_.back().insistence = 1.0;
  }
}

void Pairs::look(const Buffer<double>& x, double share, Buffer<double>& residual) {
  select(x);
  hand_on(base_, share);
  merge();
  for (Pair& pair : pairs_) {
    pair.row = pair_row(pair.sight);
    turn(pair, x);
    if (pair.sight.force.isZero(0.0)) continue;
    for (int c = 0; c < 4; ++c) at_node(residual, pair.who.node[c]) -= pair.weights[c] * pair.sight.force;
  }
}

bool Pairs::resume() {
  bool any = false;
  for (Pair& pair : pairs_) {
    if (pair.bears() || pair.sight.force.isZero(0.0) || pair.sight.gap > predicted_gap * pair.thickness) continue;
    PairSight touching = pair.sight;
    touching.gap = 0.0;
    const PairRow row = pair_row(touching);
    if (row.mode == contact_open) continue;
    pair.row = row;
    pair.row.force -= row.stiffness * pair.sight.gap * pair.sight.normal;
    any = true;
  }
  return any;
}

// The pairs of closest points at x. A vertex may be closest to an edge or a corner of a triangle: the pair counts once,
// and where all triangles around agree, since else there is a point in one of them that is closer.
void Pairs::select(const Buffer<double>& x) {
  struct Found {
    int feature, candidate;
    Vector4d weights;
  };
  const Surface& surface = near.surface;
  const int triangles = static_cast<int>(surface.triangles.size()), edges = static_cast<int>(surface.edges.size());
  const auto around_node = [&](int node) { return surface.around_begin[node + 1] - surface.around_begin[node]; };
  std::vector<Candidate>& candidates = near.pairs(x);
  const double reach = near_share * near.thickness + 2.0 * near.moved(*start_, x);
  pairs_.clear();
  least_distance_ = std::numeric_limits<double>::infinity();
  std::vector<Found> found;
  std::size_t c = 0;
  while (c < candidates.size() && candidates[c].kind == PairKind::vertex_triangle) {
    const int vertex = candidates[c].first;
    found.clear();
    for (; c < candidates.size() && candidates[c].kind == PairKind::vertex_triangle && candidates[c].first == vertex;
         ++c) {
      Candidate& who = candidates[c];
      if (who.distance > reach) continue;
      const FourPoints at = points_of(who, x);
      const Vector4d weights = closest_weights(who.kind, at);
      who.distance = between_closest(weights, at).norm();
      int corners = 0, corner = 0, opposite = 0;
      for (int i = 0; i < 3; ++i) {
        if (weights[1 + i] != 0.0) {
          ++corners;
          corner = i;
        } else {
          opposite = i;
        }
      }
      const int feature = corners == 3   ? who.second
                          : corners == 2 ? triangles + surface.triangle_edges[who.second][opposite]
                                         : triangles + edges + who.node[1 + corner];
      found.push_back({feature, static_cast<int>(c), weights});
    }
    std::sort(found.begin(), found.end(), [](const Found& a, const Found& b) {
      return a.feature != b.feature ? a.feature < b.feature : a.candidate < b.candidate;
    });
    for (std::size_t i = 0, next = 0; i < found.size(); i = next) {
      const int feature = found[i].feature;
      while (next < found.size() && found[next].feature == feature) ++next;
      const int around = feature < triangles           ? 1
                         : feature < triangles + edges ? surface.triangles_of_edge[feature - triangles]
                                                       : around_node(feature - triangles - edges);
      if (static_cast<int>(next - i) != around || candidates[found[i].candidate].distance > reach) continue;
      if (feature >= triangles + edges) {  // two corners that are each other's closest are one pair
        const int other = feature - triangles - edges;
        const auto first = std::lower_bound(pairs_.begin(), pairs_.end(), other,
                                            [](const Pair& pair, int who) { return pair.who.first < who; });
        if (std::any_of(first, pairs_.end(), [&](const Pair& pair) {
              return pair.who.first == other && pair.feature == triangles + edges + vertex;
            })) {
          continue;
        }
      }
      add(candidates[found[i].candidate], feature, found[i].weights, x);
    }
  }
  for (; c < candidates.size(); ++c) {
    Candidate& who = candidates[c];
    if (who.distance > reach) continue;
    const FourPoints at = points_of(who, x);
    const Vector4d weights = closest_weights(who.kind, at);
    who.distance = between_closest(weights, at).norm();
    if (who.distance > reach || weights.cwiseAbs().minCoeff() < end_share || crossing_squared(at) < crossing_least)
      continue;
    add(who, who.second, weights, x);
  }
}

void Pairs::add(const Candidate& who, int feature, const Vector4d& weights, const Buffer<double>& x) {
  const FourPoints at = points_of(who, x), before = points_of(who, *start_);
  const Vector3d rho = between_closest(weights, at);
  const double distance = rho.norm();
  least_distance_ = std::min(least_distance_, distance);
  Vector4d along_first = Vector4d::Zero(), along_second = Vector4d::Zero();
  if (who.kind == PairKind::edge_edge) {
    along_first << -1.0, 1.0, 0.0, 0.0;
    along_second << 0.0, 0.0, 1.0, -1.0;
  } else {
    int base = -1;
    for (int c = 1; c < 4; ++c) {
      if (weights[c] == 0.0) continue;
      if (base < 0) {
        base = c;
        continue;
      }
      Vector4d& along = along_first.isZero(0.0) ? along_first : along_second;
      along[base] = 1.0;
      along[c] = -1.0;
    }
  }
  Motions given = Motions::Zero();
  for (int c = 0; c < 4; ++c) {
    const int node = who.node[c];
    if (node < free_nodes_) continue;
    const Vector3d way = at_node(*ends_, node) - at_node(x, node);
    given.segment<3>(0) += weights[c] * way;
    given.segment<3>(3) += along_first[c] * way;
    given.segment<3>(6) += along_second[c] * way;
  }
  if (!(distance > 0.0)) return;
  const Vector3d n = rho / distance;
  const double share = stiff ? stiff_mean_share : mean_share;
  double softness = 0.0, softness_along = 0.0;  // m/N: in the mean, and along the normal
  for (int c = 0; c < 4; ++c) {
    if (who.node[c] >= free_nodes_) continue;
    const Matrix3d& own = own_[who.node[c]];
    const double mean = own.trace() / 3.0;
    softness += weights[c] * weights[c] / mean;
    softness_along += weights[c] * weights[c] / (share * mean + std::max(n.dot(own * n), 0.0));
  }
  if (!(softness > 0.0)) return;
  // The way of the first over the second, less that by which rho turns: with a surface, or half with each.
  const int a = near.surface.sheet_of_node[who.node[0]], b = near.surface.sheet_of_node[who.node[3]];
  Matrix3d turn = Matrix3d::Zero();
  for (int c = 0; c < 4; ++c) {
    const int own = near.surface.sheet_of_node[who.node[c]], other = who.on_first(c) ? b : a;
    const double share = own >= settings_.sheets ? 1.0 : other >= settings_.sheets ? 0.0 : 0.5;
    if (share * weights[c] != 0.0) turn += share * std::abs(weights[c]) * turns_.of(near.surface, who.node[c]);
  }
  Vector3d slip = rho - turn * between_closest(weights, before);
  slip -= slip.dot(n) * n;
  const double mu = settings_.mu(a, b), thickness = settings_.apart(who.kind, a, b);
  const Vector3d first =
      who.kind == PairKind::vertex_triangle ? at[0] : Vector3d(weights[0] * at[0] + weights[1] * at[1]);
  pairs_.push_back({who,
                    feature,
                    weights,
                    {distance - thickness, n, slip, Vector3d::Zero(), mu, law_share / softness,
                     smoothing > 0.0 ? smooth_proximal_share / softness : proximal_share / softness_along,
                     (smoothing > 0.0 ? smooth_proximal_share : proximal_share) / softness,
                     law_share / softness * smoothing * smoothing},
                    first - 0.5 * rho,
                    thickness,
                    along_first,
                    along_second,
                    given});
}

// Pairs take the forces they had. The force of one that is gone goes to the most alike of those that are new and have
// the vertex, or an edge, in common: the closest feature has changed.
void Pairs::hand_on(const std::vector<PairPast>& before, double share) {
  std::vector<const PairPast*> orphans;
  std::vector<std::size_t> fresh;
  std::size_t o = 0;
  for (std::size_t i = 0; i < pairs_.size(); ++i) {
    for (; o < before.size() && key(before[o]) < key(pairs_[i]); ++o) orphans.push_back(&before[o]);
    if (o < before.size() && key(before[o]) == key(pairs_[i])) {
      pairs_[i].sight.force = before[o].force + share * before[o].change;
      pairs_[i].insistence = before[o].insistence;
      const int mode = before[o].mode;
      const double last = before[o].missed, now = missed(pairs_[i].sight, mode);
      if (smoothing == 0.0 && share == 1.0 && mode != contact_open && last > insist_from &&
          last < insist_up_to * pairs_[i].thickness && now > insist_above * last) {
        pairs_[i].insistence = std::min(insist_more * before[o].insistence, insist_max);
      }
      pairs_[i].sight.along *= pairs_[i].insistence;
      pairs_[i].sight.across *= pairs_[i].insistence;
      ++o;
    } else {
      fresh.push_back(i);
    }
  }
  for (; o < before.size(); ++o) orphans.push_back(&before[o]);
  for (const PairPast* orphan : orphans) {
    const Vector3d force = orphan->force + share * orphan->change;
    if (force.isZero(0.0)) continue;
    std::size_t heir = pairs_.size();
    double best = hand_on_cosine;
    for (std::size_t i : fresh) {
      const Candidate &a = pairs_[i].who, &b = orphan->who;
      if (a.kind != b.kind) continue;
      const bool common = a.kind == PairKind::vertex_triangle ? a.first == b.first
                                                              : a.first == b.first || a.second == b.second ||
                                                                    a.first == b.second || a.second == b.first;
      if (!common) continue;
      const double alike = pairs_[i].sight.normal.dot(orphan->normal);
      if (alike > best) best = alike, heir = i;
    }
    if (heir < pairs_.size()) {
      pairs_[heir].sight.force += force;
      continue;
    }
    best = hand_on_share * orphan->thickness;
    for (std::size_t i = 0; i < pairs_.size(); ++i) {
      const double far = (pairs_[i].middle - orphan->middle).norm();
      const double alike = pairs_[i].sight.normal.dot(orphan->normal);
      if (far < best && std::abs(alike) > hand_on_cosine) best = far, heir = i;
    }
    if (heir < pairs_.size()) {
      pairs_[heir].sight.force += pairs_[heir].sight.normal.dot(orphan->normal) > 0.0 ? force : Vector3d(-force);
    }
  }
}

// Leaves one of the pairs that are at nearly the same place, as where a vertex lies on a vertex: they would say the
// same but for rounding, and contradict each other. One that keeps more apart stays before one that keeps less, then
// one that has a force before one that has none, then the closer one; it takes the forces of the others.
void Pairs::merge() {
  const std::size_t count = pairs_.size();
  const Vector3d across(0.62, 0.55, 0.56);  // along no edge of a mesh that is aligned with the axes
  std::vector<std::pair<double, std::size_t>> line(count);
  for (std::size_t i = 0; i < count; ++i) line[i] = {across.dot(pairs_[i].middle), i};
  std::sort(line.begin(), line.end());
  std::vector<std::size_t> place(count), order(count);
  for (std::size_t l = 0; l < count; ++l) place[line[l].second] = l;
  std::iota(order.begin(), order.end(), std::size_t{0});
  std::vector<std::tuple<bool, bool, double>> rank(count);  // whether it keeps less apart, has no force; its gap
  for (std::size_t i = 0; i < count; ++i) {
    const auto sheet = [&](int c) { return near.surface.sheet_of_node[pairs_[i].who.node[c]]; };
    rank[i] = {pairs_[i].thickness < settings_.apart(sheet(0), sheet(3)), pairs_[i].sight.force.isZero(0.0),
               pairs_[i].sight.gap};
  }
  std::stable_sort(order.begin(), order.end(), [&](std::size_t a, std::size_t b) { return rank[a] < rank[b]; });
  std::vector<char> gone(count, 0);
  for (std::size_t i : order) {
    if (gone[i]) continue;
    const double radius = merge_share * pairs_[i].thickness;
    const auto take = [&](std::size_t j) {
      if (gone[j] || (pairs_[j].middle - pairs_[i].middle).squaredNorm() > radius * radius) return;
      const Vector3d& force = pairs_[j].sight.force;
      pairs_[i].sight.force += pairs_[i].sight.normal.dot(pairs_[j].sight.normal) > 0.0 ? force : Vector3d(-force);
      gone[j] = 1;
    };
    const double reach = 1.01 * radius;
    for (std::size_t l = place[i]; l-- > 0 && line[place[i]].first - line[l].first < reach;) take(line[l].second);
    for (std::size_t l = place[i] + 1; l < count && line[l].first - line[place[i]].first < reach; ++l)
      take(line[l].second);
  }
  std::size_t kept = 0;
  for (std::size_t i = 0; i < count; ++i) {
    if (gone[i]) continue;
    if (kept != i) pairs_[kept] = pairs_[i];
    ++kept;
  }
  pairs_.erase(pairs_.begin() + static_cast<std::ptrdiff_t>(kept), pairs_.end());
}

void Pairs::add_stiffness(double share, std::vector<double>& stiffness) const {
  for (const Pair& pair : pairs_) {
    if (!pair.bears()) continue;
    const double own = share * pair.row.symmetric.trace() / (3.0 * pair.insistence);
    for (int c = 0; c < 4; ++c) {
      if (pair.who.node[c] < free_nodes_) stiffness[pair.who.node[c]] += pair.weights[c] * pair.weights[c] * own;
    }
  }
}

void Pairs::count_errors(double stiffness, Norms& norms) const {
  for (const Pair& pair : pairs_) {
    PairSight sight = pair.sight;
    sight.stiffness = stiffness;
    const double error = pair_error_squared(sight);
    if (error != 0.0) norms.count(error);
  }
}

bool Pairs::matter() const {
  return std::any_of(pairs_.begin(), pairs_.end(), [this](const Pair& pair) {
    const auto sheet = [&](int c) { return near.surface.sheet_of_node[pair.who.node[c]]; };
    return pair.bears() || std::max(sheet(0), sheet(3)) < settings_.sheets;
  });
}

bool Pairs::active() const {
  return std::any_of(pairs_.begin(), pairs_.end(),
                     [](const Pair& pair) { return pair.bears() || !pair.sight.force.isZero(0.0); });
}

double Pairs::smoothed_force() const {
  double sum = 0.0;
  for (const Pair& pair : pairs_) sum += pair.sight.stiffness;
  return pairs_.empty() ? 0.0 : smoothing * sum / static_cast<double>(pairs_.size());
}

int Pairs::bearing() const {
  return static_cast<int>(std::count_if(pairs_.begin(), pairs_.end(), [](const Pair& pair) { return pair.bears(); }));
}

bool Pairs::activate(const Buffer<float>& change) {
  bool changed = false;
  for (Pair& pair : pairs_) {
    if (!pair.added) continue;
    const Vector3d force = pair.sight.force + pair.force_change(change, free_nodes_);
    if (force.dot(pair.sight.normal) >= 0.0) continue;
    pair.row = {contact_open, Matrix3d::Zero(), Matrix3d::Zero(), -pair.sight.force};
    pair.turning.setZero();
    pair.sliding.setZero();
    pair.added = false;
    pair.released = changed = true;
  }
  for (PairKind kind : {PairKind::vertex_triangle, PairKind::edge_edge}) {
    bool any = false;
    for (Pair& pair : pairs_) {
      if (pair.who.kind != kind || pair.bears() || pair.released) continue;
      const Vector3d motion = pair.motion(change, free_nodes_);
      if (!(pair.sight.gap + pair.sight.normal.dot(motion) < -predicted_gap * pair.thickness)) continue;
      pair.row = closing_row(pair.sight, motion);
      pair.added = any = true;
    }
    if (any) return true;
  }
  return changed;
}

void Pairs::solved(const Buffer<float>& change) {
  for (Pair& pair : pairs_) {
    pair.change = pair.force_change(change, free_nodes_);
    pair.added = pair.released = false;
  }
  base_.assign(pairs_.begin(), pairs_.end());
}

void Pairs::return_to_best() {
  base_ = best_;
  for (PairPast& pair : base_) pair.change.setZero();
}

PairData Pairs::rows() {
  nodes_.clear();
  weights_.clear();
  stiffness_.clear();
  for (const Pair& pair : pairs_) {
    if (!pair.bears()) continue;
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

void Pairs::subtract_right_side(Buffer<float>& force) const {
  for (const Pair& pair : pairs_) {
    Motions change = -pair.stiffness() * pair.given;
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
