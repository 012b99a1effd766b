#include "contact/pn_triangles.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <utility>

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Newton's method for a projection ends at changes of its barycentric coordinates that square to
// below rounding. More iterations than these mean that there is no projection.
constexpr int iterations_max = 12;
constexpr double converged = 1e-12;

// Rounding of barycentric coordinates: they count as inside from here.
constexpr double inside = -1e-9;
// Triangles that a projection may move over in a search, which starts from the nearest: a bound
// against cycles.
constexpr int hops_max = 100;
// Barycentric distance beyond an edge at which the search goes on in the next triangle.
constexpr double beyond_edge = 0.6;
// Barycentric distance within which a projection between two triangles belongs to either.
constexpr double between_triangles = 1e-4;
// Jacobian of the map to a projection, over that of the triangle, below which there is none: at 0
// the point is a centre of curvature.
constexpr double jacobian_min = 0.1;
// Sine of the angle of the normals of the two sides of an edge below which they are one.
constexpr double same_normal = 1e-3;

}  // namespace

Vector3d PNPatch::y(const Vector3d& b) const {
  Vector3d out = 6.0 * b[0] * b[1] * b[2] * middle;
  for (int k = 0; k < 3; ++k) {
    const double i = b[next(k)], j = b[after_next(k)];
    out += b[k] * b[k] * b[k] * corner[k] + 3.0 * i * j * (i * near[k] + j * far[k]);
  }
  return out;
}

Vector3d PNPatch::n(const Vector3d& b) const {
  Vector3d out = Vector3d::Zero();
  for (int k = 0; k < 3; ++k)
    out += b[k] * b[k] * normal[k] + 2.0 * b[next(k)] * b[after_next(k)] * bend[k];
  return out;
}

Matrix3d PNPatch::dy(const Vector3d& b) const {
  Matrix3d out;
  for (int k = 0; k < 3; ++k)
    out.col(k) = 3.0 * b[k] * b[k] * corner[k] + 6.0 * b[next(k)] * b[after_next(k)] * middle;
  for (int k = 0; k < 3; ++k) {
    const double i = b[next(k)], j = b[after_next(k)];
    out.col(next(k)) += 3.0 * j * (2.0 * i * near[k] + j * far[k]);
    out.col(after_next(k)) += 3.0 * i * (i * near[k] + 2.0 * j * far[k]);
  }
  return out;
}

Matrix3d PNPatch::dn(const Vector3d& b) const {
  Matrix3d out;
  for (int k = 0; k < 3; ++k) out.col(k) = 2.0 * b[k] * normal[k];
  for (int k = 0; k < 3; ++k) {
    out.col(next(k)) += 2.0 * b[after_next(k)] * bend[k];
    out.col(after_next(k)) += 2.0 * b[next(k)] * bend[k];
  }
  return out;
}

// Newton's method for (p - c) . c' = 0 on the cubic c, with the second derivative bounded from
// below.
double PNPatch::closest_on_edge(int k, const Vector3d& p) const {
  const Vector3d &from = corner[next(k)], &to = corner[after_next(k)];
  const Vector3d chord = to - from;
  const Vector3d a = near[k] - from, m = far[k] - near[k], e = to - far[k];
  double s = std::clamp((p - from).dot(chord) / chord.squaredNorm(), 0.0, 1.0);
  for (int n = 0; n < iterations_max; ++n) {
    const double r = 1.0 - s;
    const Vector3d c = r * r * r * from + 3.0 * r * s * (r * near[k] + s * far[k]) + s * s * s * to;
    const Vector3d d = 3.0 * (r * r * a + 2.0 * r * s * m + s * s * e),
                   dd = 6.0 * (r * (m - a) + s * (e - m));
    const double bend = std::max(d.squaredNorm() - (p - c).dot(dd), 0.1 * d.squaredNorm());
    const double moved = std::clamp(s + (p - c).dot(d) / bend, 0.0, 1.0);
    if (std::abs(std::exchange(s, moved) - moved) <= converged) break;
  }
  return s;
}

PNRoot::PNRoot(const PNPatch& patch, const Vector3d& p) {
  const Vector3d u = patch.corner[1] - patch.corner[0], v = patch.corner[2] - patch.corner[0],
                 w = u.cross(v);
  const Vector3d from = p - patch.corner[0];
  b[1] = from.cross(v).dot(w) / w.squaredNorm();
  b[2] = u.cross(from).dot(w) / w.squaredNorm();
  b[0] = 1.0 - b[1] - b[2];
  double height_ratio = from.dot(w) / w.norm();  // height over |n|, which is nearly 1
  for (int i = 0; i < iterations_max && b.minCoeff() > -beyond_edge; ++i) {
    const Matrix3d slope = patch.dy(b) + height_ratio * patch.dn(b);
    normal = patch.n(b);
    Matrix3d jacobian;
    jacobian << slope.col(1) - slope.col(0), slope.col(2) - slope.col(0), normal;
    const double size = jacobian.determinant();
    // Beyond a centre of curvature the axes turn over.
    if (!(size > jacobian_min * w.norm())) return;
    const Vector3d change = jacobian.inverse() * (p - patch.y(b) - height_ratio * normal);
    b += Vector3d(-change[0] - change[1], change[0], change[1]);
    height_ratio += change[2];
    if (change.head<2>().cwiseAbs().maxCoeff() > converged) continue;
    normal = patch.n(b);
    height = height_ratio * normal.norm();
    normal.normalize();
    point = patch.y(b);
    is_solved = true;
    return;
  }
}

PNTriangles::PNTriangles(std::vector<std::array<int, 3>> triangles, const Buffer<double>& x,
                         const std::vector<double>& crease)
    : mesh_(std::move(triangles), x, crease) {}

// Normals of corners, by the edges e and f that leave them: sum of e x f/(|e|^2 |f|^2), which is
// exact for a closed fan on a sphere [Max 1999, Eq. 2].
PatchShape PNTriangles::shape(const Buffer<double>& x) const {
  PatchShape out{x, std::vector<Vector3d>(mesh_.groups, Vector3d::Zero())};
  for (std::size_t t = 0; t < mesh_.triangles.size(); ++t) {
    for (int k = 0; k < 3; ++k) {
      const Vector3d p = at_node(x, mesh_.triangles[t][k]);
      const Vector3d e = at_node(x, mesh_.triangles[t][next(k)]) - p,
                     f = at_node(x, mesh_.triangles[t][after_next(k)]) - p;
      out.normals[mesh_.group[t][k]] += e.cross(f) / (e.squaredNorm() * f.squaredNorm());
    }
  }
  for (Vector3d& normal : out.normals) normal.normalize();
  // Of the circle that touches at a corner and goes through the next: 2 h/|P_i - P_j|^2, h = N .
  // (P_i - P_j). Handles are h/3 off the triangle and C is h/2: with the weights of these in the
  // middle, the patch is h/3 off there.
  out.curvature.assign(mesh_.groups, {0.0, 0.0});
  for (std::size_t t = 0; t < mesh_.triangles.size(); ++t) {
    for (int k = 0; k < 3; ++k) {
      for (int to : {next(k), after_next(k)}) {
        const Vector3d edge =
            at_node(x, mesh_.triangles[t][k]) - at_node(x, mesh_.triangles[t][to]);
        const double h = out.normals[mesh_.group[t][k]].dot(edge),
                     curvature = 2.0 * h / edge.squaredNorm();
        auto& most = out.curvature[mesh_.group[t][k]];
        most = {std::max(most[0], curvature), std::max(most[1], -curvature)};
        out.bulge = std::max(out.bulge, std::abs(h) / 3.0);
      }
    }
  }
  return out;
}

// E_ij of corners `from` and `to` of a triangle.
Vector3d PNTriangles::edge_handle(const PatchShape& shape, int t, int from, int to) const {
  const Vector3d p = at_node(shape.x, mesh_.triangles[t][from]),
                 chord = at_node(shape.x, mesh_.triangles[t][to]) - p;
  const Vector3d& normal = shape.normals[mesh_.group[t][from]];
  const int k = 3 - from - to, other = mesh_.across[t][k];
  if (mesh_.sharp[t][k] && other >= 0) {
    const Vector3d& beyond =
        shape.normals[mesh_.group[other][mesh_.corner_of(other, mesh_.triangles[t][from])]];
    const Vector3d both = normal.cross(beyond);
    if (both.norm() > same_normal) return p + chord.dot(both) / both.squaredNorm() * both / 3.0;
  }
  return p + (chord - chord.dot(normal) * normal) / 3.0;
}

PNPatch PNTriangles::patch(const PatchShape& shape, int t) const {
  PNPatch out;
  Vector3d corners = Vector3d::Zero(), handles = Vector3d::Zero();
  for (int k = 0; k < 3; ++k) {
    out.corner[k] = at_node(shape.x, mesh_.triangles[t][k]);
    out.normal[k] = shape.normals[mesh_.group[t][k]];
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

std::optional<Projection> PNTriangles::projection(const PatchShape& shape, const Vector3d& p, int t,
                                                  double side) const {
  int before = -1;
  for (int hop = 0; hop < hops_max; ++hop) {
    const PNRoot root(patch(shape, t), p);
    int out = 0;
    const double least = root.b.minCoeff(&out);
    if (root.is_solved && least >= inside)
      return Projection{t, root.b, root.point, side * root.normal, side * root.height, true};
    if (!root.is_solved && least >= inside) return std::nullopt;
    if (mesh_.sharp[t][out] && root.b[next(out)] < inside && !mesh_.sharp[t][next(out)])
      out = next(out);
    if (mesh_.sharp[t][out] && root.b[after_next(out)] < inside && !mesh_.sharp[t][after_next(out)])
      out = after_next(out);
    if (mesh_.sharp[t][out]) return foot_around(shape, p, t, side);
    const int beyond = mesh_.across[t][out];
    if (beyond == before && root.is_solved && least >= -between_triangles) {
      return Projection{t, root.b, root.point, side * root.normal, side * root.height, true};
    }
    before = std::exchange(t, beyond);
  }
  return std::nullopt;
}

// The closest of all feet in the triangles around one, on their sharp edges and at the ends of
// these.
std::optional<Projection> PNTriangles::foot_around(const PatchShape& shape, const Vector3d& p,
                                                   int t, double side) const {
  std::vector<int> near_triangles;
  for (int node : mesh_.triangles[t]) {
    near_triangles.insert(near_triangles.end(), mesh_.around.begin() + mesh_.around_begin[node],
                          mesh_.around.begin() + mesh_.around_begin[node + 1]);
  }
  std::sort(near_triangles.begin(), near_triangles.end());
  near_triangles.erase(std::unique(near_triangles.begin(), near_triangles.end()),
                       near_triangles.end());
  std::optional<Projection> best;
  const auto take = [&](const Projection& projection) {
    if (!best || projection.height < best->height) best = projection;
  };
  for (int q : near_triangles) {
    const PNPatch near_patch = patch(shape, q);
    const PNRoot root(near_patch, p);
    if (root.is_solved && root.b.minCoeff() >= inside && side * root.height > 0.0) {
      take({q, root.b, root.point, side * root.normal, side * root.height, true});
    }
    for (int k = 0; k < 3; ++k) {
      if (!mesh_.sharp[q][k]) continue;
      const int i = next(k), j = after_next(k);
      const double s = near_patch.closest_on_edge(k, p);
      Vector3d b = Vector3d::Zero();
      b[i] = 1.0 - s;
      b[j] = s;
      const Vector3d c = near_patch.y(b), away = p - c;
      const double far = away.norm();
      if (far > 0.0) take({q, b, c, away / far, far, false});
    }
  }
  return best;
}

double PNTriangles::side_of(const PatchShape& shape, const Vector3d& p, int t,
                            const Vector3d& weights) const {
  const auto& corners = mesh_.triangles[t];
  Vector3d c = Vector3d::Zero(), normal = mesh_.facet_normal(shape.x, t);
  for (int k = 0; k < 3; ++k) c += weights[k] * at_node(shape.x, corners[k]);
  for (int k = 0; k < 3; ++k) {
    if (weights[k] == 1.0) {
      normal.setZero();
      for (int a = mesh_.around_begin[corners[k]]; a < mesh_.around_begin[corners[k] + 1]; ++a) {
        const auto& corners_there = mesh_.triangles[mesh_.around[a]];
        const int corner = mesh_.corner_of(mesh_.around[a], corners[k]);
        const Vector3d e = at_node(shape.x, corners_there[next(corner)]) - c,
                       f = at_node(shape.x, corners_there[after_next(corner)]) - c;
        normal +=
            std::atan2(e.cross(f).norm(), e.dot(f)) * mesh_.facet_normal(shape.x, mesh_.around[a]);
      }
    } else if (weights[k] == 0.0 && weights.maxCoeff() < 1.0 && mesh_.across[t][k] >= 0) {
      normal += mesh_.facet_normal(shape.x, mesh_.across[t][k]);
    }
  }
  return normal.dot(p - c) < 0.0 ? -1.0 : 1.0;
}

double PNTriangles::curvature(const PatchShape& shape, int t, const Vector3d& weights,
                              double side) const {
  double out = 0.0;
  for (int k = 0; k < 3; ++k) out += weights[k] * shape.curvature[mesh_.group[t][k]][side < 0.0];
  return out;
}

Vector3d PNTriangles::point(const PatchShape& shape, int t, const Vector3d& weights) const {
  return patch(shape, t).y(weights);
}

Matrix3d PNTriangles::axes(const PatchShape& shape, int t, const Vector3d& weights) const {
  const PNPatch pn_patch = patch(shape, t);
  const Matrix3d slope = pn_patch.dy(weights);
  Matrix3d out;
  out.col(2) = pn_patch.n(weights).normalized();
  out.col(1) = out.col(2).cross(slope.col(1) - slope.col(0)).normalized();
  out.col(0) = out.col(1).cross(out.col(2));
  return out;
}

}  // namespace sim_core
