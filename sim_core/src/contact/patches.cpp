#include "contact/patches.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numeric>
#include <utility>

#include "contact/closest.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Newton's iterations for a foot, and the change of its barycentric coordinates at which they end.
constexpr int iterations_max = 12;
constexpr double converged = 1e-12;
// Barycentric coordinates that count as inside, those of a foot in either of two triangles at their edge, and those at
// which the search goes on in the next triangle.
constexpr double inside = -1e-9, between = -1e-4, far_out = -0.6;
// Triangles that a foot may move over in a search.
constexpr int hops_max = 100;
// Normals of the two sides of a sharp edge that are nearer to each other, as the sine of their angle, are one.
constexpr double same_normal = 1e-3;

int next(int corner) { return (corner + 1) % 3; }
int after_next(int corner) { return (corner + 2) % 3; }

int corner_of(const std::array<int, 3>& triangle, int node) {
  return static_cast<int>(std::find(triangle.begin(), triangle.end(), node) - triangle.begin());
}

struct Groups {
  std::vector<int> parent;
  explicit Groups(std::size_t count) : parent(count) { std::iota(parent.begin(), parent.end(), 0); }
  int root(int i) {
    while (parent[i] != i) i = parent[i] = parent[parent[i]];
    return i;
  }
  void join(int i, int j) { parent[std::max(root(i), root(j))] = std::min(root(i), root(j)); }
};

}  // namespace

// Of one triangle: what y and N are made of.
struct Patches::Patch {
  std::array<Vector3d, 3> corner, normal;
  std::array<Vector3d, 3> near, far;  // of the edge opposite each corner: E_ij and E_ji, i the next corner
  std::array<Vector3d, 3> bend;       // Q_ij of that edge
  Vector3d middle;                    // C

  Vector3d y(const Vector3d& b) const {
    Vector3d out = 6.0 * b[0] * b[1] * b[2] * middle;
    for (int k = 0; k < 3; ++k) {
      const double i = b[next(k)], j = b[after_next(k)];
      out += b[k] * b[k] * b[k] * corner[k] + 3.0 * i * j * (i * near[k] + j * far[k]);
    }
    return out;
  }
  Vector3d n(const Vector3d& b) const {
    Vector3d out = Vector3d::Zero();
    for (int k = 0; k < 3; ++k) out += b[k] * b[k] * normal[k] + 2.0 * b[next(k)] * b[after_next(k)] * bend[k];
    return out;
  }
  // Derivatives by each b.
  Matrix3d dy(const Vector3d& b) const {
    Matrix3d out;
    for (int k = 0; k < 3; ++k) {
      out.col(k) = 3.0 * b[k] * b[k] * corner[k] + 6.0 * b[next(k)] * b[after_next(k)] * middle;
    }
    for (int k = 0; k < 3; ++k) {
      const double i = b[next(k)], j = b[after_next(k)];
      out.col(next(k)) += 3.0 * j * (2.0 * i * near[k] + j * far[k]);
      out.col(after_next(k)) += 3.0 * i * (i * near[k] + 2.0 * j * far[k]);
    }
    return out;
  }
  Matrix3d dn(const Vector3d& b) const {
    Matrix3d out;
    for (int k = 0; k < 3; ++k) out.col(k) = 2.0 * b[k] * normal[k];
    for (int k = 0; k < 3; ++k) {
      out.col(next(k)) += 2.0 * b[after_next(k)] * bend[k];
      out.col(after_next(k)) += 2.0 * b[next(k)] * bend[k];
    }
    return out;
  }
};

// Of y(b) + height n(b)/|n| = p in one triangle, or of what continues it beyond its edges.
struct Patches::Root {
  Vector3d b, normal, point;
  double height = 0.0;
  bool found = false;

  Root(const Patch& patch, const Vector3d& p) {
    const Vector3d u = patch.corner[1] - patch.corner[0], v = patch.corner[2] - patch.corner[0], w = u.cross(v);
    const Vector3d from = p - patch.corner[0];
    b[1] = from.cross(v).dot(w) / w.squaredNorm();
    b[2] = u.cross(from).dot(w) / w.squaredNorm();
    b[0] = 1.0 - b[1] - b[2];
    double share = from.dot(w) / w.norm();  // height over |n|, which is nearly 1
    for (int i = 0; i < iterations_max && b.minCoeff() > far_out; ++i) {
      const Matrix3d slope = patch.dy(b) + share * patch.dn(b);
      normal = patch.n(b);
      Matrix3d jacobian;
      jacobian << slope.col(1) - slope.col(0), slope.col(2) - slope.col(0), normal;
      const double size = jacobian.determinant();
      // Beyond a centre of curvature the axes turn over.
      if (!(size > 0.1 * w.norm())) return;
      const Vector3d change = jacobian.inverse() * (p - patch.y(b) - share * normal);
      b += Vector3d(-change[0] - change[1], change[0], change[1]);
      share += change[2];
      if (change.head<2>().cwiseAbs().maxCoeff() > converged) continue;
      normal = patch.n(b);
      height = share * normal.norm();
      normal.normalize();
      point = patch.y(b);
      found = true;
      return;
    }
  }
};

Patches::Patches(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x, const std::vector<double>& crease)
    : triangles_(std::move(triangles)) {
  const int count = static_cast<int>(triangles_.size());
  std::map<std::array<int, 2>, std::vector<int>> sides;  // triangles at each edge
  for (int t = 0; t < count; ++t) {
    for (int k = 0; k < 3; ++k) {
      const int i = triangles_[t][next(k)], j = triangles_[t][after_next(k)];
      sides[{std::min(i, j), std::max(i, j)}].push_back(t);
    }
  }
  const auto edge = [&](int t, int k) -> const std::vector<int>& {
    const int i = triangles_[t][next(k)], j = triangles_[t][after_next(k)];
    return sides.at({std::min(i, j), std::max(i, j)});
  };
  const auto runs = [&](int t, int i, int j) {  // whether i comes before j in the triangle
    return triangles_[t][next(corner_of(triangles_[t], i))] == j;
  };
  std::vector<char> seen(count, 0);
  for (int first = 0; first < count; ++first) {
    if (seen[first]) continue;
    std::vector<int> queue{first};
    seen[first] = 1;
    for (std::size_t q = 0; q < queue.size(); ++q) {
      const int t = queue[q];
      for (int k = 0; k < 3; ++k) {
        const int i = triangles_[t][next(k)], j = triangles_[t][after_next(k)];
        if (edge(t, k).size() != 2) continue;
        const int other = edge(t, k)[edge(t, k)[0] == t];
        if (seen[other]) continue;
        seen[other] = 1;
        if (runs(other, i, j)) std::swap(triangles_[other][1], triangles_[other][2]);
        queue.push_back(other);
      }
    }
  }
  across_.assign(count, {-1, -1, -1});
  sharp_.assign(count, {1, 1, 1});
  Groups groups(3 * static_cast<std::size_t>(count));
  for (int t = 0; t < count; ++t) {
    for (int k = 0; k < 3; ++k) {
      if (edge(t, k).size() != 2) continue;
      const int i = triangles_[t][next(k)], j = triangles_[t][after_next(k)];
      const int other = edge(t, k)[edge(t, k)[0] == t];
      across_[t][k] = other;
      const Vector3d a = facet_normal(x, t), b = facet_normal(x, other);
      const double angle = std::atan2(a.cross(b).norm(), a.dot(b));
      if (runs(other, i, j) || angle > std::min(crease[t], crease[other])) continue;
      sharp_[t][k] = 0;
      for (int node : {i, j})
        groups.join(3 * t + corner_of(triangles_[t], node), 3 * other + corner_of(triangles_[other], node));
    }
  }
  std::vector<int> number(3 * static_cast<std::size_t>(count), -1);
  group_.resize(count);
  for (int c = 0; c < 3 * count; ++c) {
    int& of_root = number[groups.root(c)];
    if (of_root < 0) of_root = groups_++;
    group_[c / 3][c % 3] = of_root;
  }
  around_begin_.assign(x.size() / 4 + 1, 0);
  for (const auto& corners : triangles_) {
    for (int node : corners) ++around_begin_[node + 1];
  }
  std::partial_sum(around_begin_.begin(), around_begin_.end(), around_begin_.begin());
  around_.resize(around_begin_.back());
  std::vector<int> place(around_begin_.begin(), around_begin_.end() - 1);
  for (int t = 0; t < count; ++t) {
    for (int node : triangles_[t]) around_[place[node]++] = t;
  }
}

Vector3d Patches::facet_normal(const Buffer<double>& x, int t) const {
  const auto& c = triangles_[t];
  return (at_node(x, c[1]) - at_node(x, c[0])).cross(at_node(x, c[2]) - at_node(x, c[0])).normalized();
}

// Normals of corners, by the edges e and f that leave them: sum of e x f/(|e|^2 |f|^2), which is exact for a closed fan
// on a sphere [Max 1999, Eq. 2].
PatchShape Patches::shape(const Buffer<double>& x) const {
  PatchShape out{x, std::vector<Vector3d>(groups_, Vector3d::Zero())};
  for (std::size_t t = 0; t < triangles_.size(); ++t) {
    for (int k = 0; k < 3; ++k) {
      const Vector3d p = at_node(x, triangles_[t][k]);
      const Vector3d e = at_node(x, triangles_[t][next(k)]) - p, f = at_node(x, triangles_[t][after_next(k)]) - p;
      out.normals[group_[t][k]] += e.cross(f) / (e.squaredNorm() * f.squaredNorm());
    }
  }
  for (Vector3d& normal : out.normals) normal.normalize();
  // Of the circle that touches at a corner and goes through the next: 2 N . (P_i - P_j)/|P_i - P_j|^2.
  out.curvature.assign(groups_, {0.0, 0.0});
  for (std::size_t t = 0; t < triangles_.size(); ++t) {
    for (int k = 0; k < 3; ++k) {
      for (int to : {next(k), after_next(k)}) {
        const Vector3d edge = at_node(x, triangles_[t][k]) - at_node(x, triangles_[t][to]);
        const double bulge = 2.0 * out.normals[group_[t][k]].dot(edge) / edge.squaredNorm();
        auto& most = out.curvature[group_[t][k]];
        most = {std::max(most[0], bulge), std::max(most[1], -bulge)};
      }
    }
  }
  return out;
}

// E_ij of corners `from` and `to` of a triangle.
Vector3d Patches::edge_handle(const PatchShape& shape, int t, int from, int to) const {
  const Vector3d p = at_node(shape.x, triangles_[t][from]), chord = at_node(shape.x, triangles_[t][to]) - p;
  const Vector3d& own = shape.normals[group_[t][from]];
  const int k = 3 - from - to, other = across_[t][k];
  if (sharp_[t][k] && other >= 0) {
    const Vector3d& beyond = shape.normals[group_[other][corner_of(triangles_[other], triangles_[t][from])]];
    const Vector3d both = own.cross(beyond);
    if (both.norm() > same_normal) return p + chord.dot(both) / both.squaredNorm() * both / 3.0;
  }
  return p + (chord - chord.dot(own) * own) / 3.0;
}

Patches::Patch Patches::patch(const PatchShape& shape, int t) const {
  Patch out;
  Vector3d corners = Vector3d::Zero(), handles = Vector3d::Zero();
  for (int k = 0; k < 3; ++k) {
    out.corner[k] = at_node(shape.x, triangles_[t][k]);
    out.normal[k] = shape.normals[group_[t][k]];
    corners += out.corner[k] / 3.0;
  }
  for (int k = 0; k < 3; ++k) {
    const int i = next(k), j = after_next(k);
    out.near[k] = edge_handle(shape, t, i, j);
    out.far[k] = edge_handle(shape, t, j, i);
    handles += (out.near[k] + out.far[k]) / 6.0;
    const Vector3d sum = out.normal[i] + out.normal[j],
                   tangent = out.corner[j] + out.far[k] - out.near[k] - out.corner[i];
    const Vector3d m = (sum - sum.dot(tangent) / tangent.squaredNorm() * tangent).normalized();
    out.bend[k] = 2.0 * m - 0.5 * sum;
  }
  out.middle = 1.5 * handles - 0.5 * corners;
  return out;
}

std::optional<Foot> Patches::foot(const PatchShape& shape, const Vector3d& p, int t, double side) const {
  int before = -1;
  for (int hop = 0; hop < hops_max; ++hop) {
    const Root root(patch(shape, t), p);
    int out = 0;
    const double least = root.b.minCoeff(&out);
    if (root.found && least >= inside) return Foot{t, root.b, root.point, side * root.normal, side * root.height, true};
    if (!root.found && least >= inside) return std::nullopt;
    if (sharp_[t][out] && root.b[next(out)] < inside && !sharp_[t][next(out)]) out = next(out);
    if (sharp_[t][out] && root.b[after_next(out)] < inside && !sharp_[t][after_next(out)]) out = after_next(out);
    if (sharp_[t][out]) return foot_around(shape, p, t, side);
    const int beyond = across_[t][out];
    if (beyond == before && root.found && least >= between) {
      return Foot{t, root.b, root.point, side * root.normal, side * root.height, true};
    }
    before = std::exchange(t, beyond);
  }
  return std::nullopt;
}

// The closest of all feet in the triangles around one, on their sharp edges and at the ends of these.
std::optional<Foot> Patches::foot_around(const PatchShape& shape, const Vector3d& p, int t, double side) const {
  std::vector<int> some;
  for (int node : triangles_[t]) {
    some.insert(some.end(), around_.begin() + around_begin_[node], around_.begin() + around_begin_[node + 1]);
  }
  std::sort(some.begin(), some.end());
  some.erase(std::unique(some.begin(), some.end()), some.end());
  std::optional<Foot> best;
  const auto take = [&](const Foot& foot) {
    if (!best || foot.height < best->height) best = foot;
  };
  for (int q : some) {
    const Patch one = patch(shape, q);
    const Root root(one, p);
    if (root.found && root.b.minCoeff() >= inside && side * root.height > 0.0) {
      take({q, root.b, root.point, side * root.normal, side * root.height, true});
    }
    for (int k = 0; k < 3; ++k) {
      if (!sharp_[q][k]) continue;
      // (p - c) . c' = 0 along the edge, or its end.
      const int i = next(k), j = after_next(k);
      const Vector3d chord = one.corner[j] - one.corner[i];
      double s = std::clamp((p - one.corner[i]).dot(chord) / chord.squaredNorm(), 0.0, 1.0);
      for (int n = 0; n < iterations_max; ++n) {
        const double r = 1.0 - s;
        const Vector3d a = one.near[k] - one.corner[i], m = one.far[k] - one.near[k], e = one.corner[j] - one.far[k];
        const Vector3d c =
            r * r * r * one.corner[i] + 3.0 * r * s * (r * one.near[k] + s * one.far[k]) + s * s * s * one.corner[j];
        const Vector3d d = 3.0 * (r * r * a + 2.0 * r * s * m + s * s * e), dd = 6.0 * (r * (m - a) + s * (e - m));
        const double bend = std::max(d.squaredNorm() - (p - c).dot(dd), 0.1 * d.squaredNorm());
        const double to = std::clamp(s + (p - c).dot(d) / bend, 0.0, 1.0);
        if (std::abs(std::exchange(s, to) - to) <= converged) break;
      }
      Vector3d b = Vector3d::Zero();
      b[i] = 1.0 - s;
      b[j] = s;
      const Vector3d c = one.y(b), away = p - c;
      const double far = away.norm();
      if (far > 0.0) take({q, b, c, away / far, far, false});
    }
  }
  return best;
}

double Patches::side_of(const PatchShape& shape, const Vector3d& p, int t, const Vector3d& weights) const {
  const auto& corners = triangles_[t];
  Vector3d c = Vector3d::Zero(), normal = facet_normal(shape.x, t);
  for (int k = 0; k < 3; ++k) c += weights[k] * at_node(shape.x, corners[k]);
  for (int k = 0; k < 3; ++k) {
    if (weights[k] == 1.0) {
      normal.setZero();
      for (int a = around_begin_[corners[k]]; a < around_begin_[corners[k] + 1]; ++a) {
        const auto& others = triangles_[around_[a]];
        const int own = corner_of(others, corners[k]);
        const Vector3d e = at_node(shape.x, others[next(own)]) - c, f = at_node(shape.x, others[after_next(own)]) - c;
        normal += std::atan2(e.cross(f).norm(), e.dot(f)) * facet_normal(shape.x, around_[a]);
      }
    } else if (weights[k] == 0.0 && weights.maxCoeff() < 1.0 && across_[t][k] >= 0) {
      normal += facet_normal(shape.x, across_[t][k]);
    }
  }
  return normal.dot(p - c) < 0.0 ? -1.0 : 1.0;
}

double Patches::curvature(const PatchShape& shape, int t, const Vector3d& weights, double side) const {
  double out = 0.0;
  for (int k = 0; k < 3; ++k) out += weights[k] * shape.curvature[group_[t][k]][side < 0.0];
  return out;
}

Vector3d Patches::point(const PatchShape& shape, int t, const Vector3d& weights) const {
  return patch(shape, t).y(weights);
}

Matrix3d Patches::axes(const PatchShape& shape, int t, const Vector3d& weights) const {
  const Patch one = patch(shape, t);
  const Matrix3d slope = one.dy(weights);
  Matrix3d out;
  out.col(2) = one.n(weights).normalized();
  out.col(1) = out.col(2).cross(slope.col(1) - slope.col(0)).normalized();
  out.col(0) = out.col(1).cross(out.col(2));
  return out;
}

}  // namespace sim_core
