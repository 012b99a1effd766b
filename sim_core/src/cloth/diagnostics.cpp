#include <Eigen/LU>
#include <algorithm>
#include <cmath>

#include "cloth/stepping.hpp"
#include "math/refusal.hpp"

namespace sim_core {

using Eigen::Matrix2d;
using Eigen::Matrix3d;
using Eigen::Vector2d;
using Eigen::Vector3d;

namespace {

// By how far flat triangles with a circle of radius `circle` around them sink into a body of radius
// `radius`, on whose face their corners are.
double sagitta(double radius, double circle) {
  return radius - std::sqrt(std::max(0.0, radius * radius - circle * circle));
}

}  // namespace

StepDiagnostics::StepDiagnostics(const ClothMesh& mesh, const Assembly& assembly, double inside)
    : assembly_(assembly), inside_(inside), cell_(mesh.rest.rows(), 0.0) {
  std::vector<int> around(mesh.rest.rows(), 0);
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    Matrix2d sides;
    for (int c = 0; c < 3; ++c) {
      const int vertex = mesh.triangles(t, c);
      nodes_.push_back(assembly.numbering.node[vertex]);
      cell_[vertex] += 2.0 * mesh.area[t];
      ++around[vertex];
      if (c > 0)
        sides.col(c - 1) =
            (mesh.rest.row(vertex) - mesh.rest.row(mesh.triangles(t, 0))).transpose();
    }
    const Matrix2d inverse = sides.inverse();
    inverse_.insert(inverse_.end(), inverse.data(), inverse.data() + 4);
    const double a = sides.col(0).norm(), b = sides.col(1).norm(),
                 c = (sides.col(0) - sides.col(1)).norm();
    circle_ = std::max(circle_, a * b * c / (4.0 * mesh.area[t]));
  }
  for (std::size_t v = 0; v < cell_.size(); ++v) cell_[v] = std::sqrt(cell_[v] / around[v]);
}

DiagnosticExtremes StepDiagnostics::measure(const StepTaken& step, const Newton& newton) {
  DiagnosticExtremes out;
  out.stretch = largest_stretch(step.x);
  for (std::size_t b = 0; b < step.at_end.size(); ++b) {
    out.depth = std::max(out.depth, depth_in(step.at_end[b], step.x));
    out.passages += passages(step.at_start[b], step.at_end[b], step);
  }
  measure_contacts(step, newton, out);
  measure_energy(step, newton, out);
  return out;
}

// The larger principal value of F^T F, and its root.
double StepDiagnostics::largest_stretch(const Buffer<double>& x) const {
  double largest = 0.0;
  const int* node = nodes_.data();
  for (const double* inverse = inverse_.data(); inverse != inverse_.data() + inverse_.size();
       inverse += 4, node += 3) {
    const Vector3d p = at_node(x, node[0]), u = at_node(x, node[1]) - p,
                   v = at_node(x, node[2]) - p;
    const Vector3d f = u * inverse[0] + v * inverse[1], g = u * inverse[2] + v * inverse[3];
    const double ff = f.squaredNorm(), gg = g.squaredNorm(), fg = f.dot(g), half = 0.5 * (ff - gg);
    const double square = 0.5 * (ff + gg) + std::sqrt(half * half + fg * fg);
    if (!(square <= largest)) largest = square;  // a NaN stays
  }
  return std::sqrt(largest);
}

// Where a body is rounder than the triangles, its depth is that of the vertices; else between them,
// too.
double StepDiagnostics::depth_in(const Body& body, const Buffer<double>& x) const {
  double deepest = 0.0;
  const Numbering& numbering = assembly_.numbering;
  for (int i = 0; i < numbering.vertices; ++i) {
    const double distance = gap_of(body, at_node(x, numbering.node[i])).distance;
    if (distance < 0.0) deepest = std::max(deepest, -distance / cell_[i]);
  }
  if (body.shape == Body::plane || body.radius >= circle_) return deepest;
  const double allowed = sagitta(body.radius, circle_);
  for (std::size_t t = 0; t < nodes_.size(); t += 3) {
    const int* node = &nodes_[t];
    const Vector3d p[3] = {at_node(x, node[0]), at_node(x, node[1]), at_node(x, node[2])};
    const Vector3d middle = (p[0] + p[1] + p[2]) / 3.0;
    const double cell = cell_[numbering.vertex[node[0]]], from = gap_of(body, middle).distance;
    if (from > cell) continue;
    double least = from;
    for (int c = 0; c < 3; ++c)
      least = std::min(least, gap_of(body, 0.5 * (p[c] + p[(c + 1) % 3])).distance);
    deepest = std::max(deepest, (-least - allowed) / cell);
  }
  return deepest;
}

// No triangle comes to a core unless it is as large as the body is thick, or goes as far in a step.
int StepDiagnostics::passages(const Body& begin, const Body& end, const StepTaken& step) const {
  const Core core = core_of(end);
  if (!std::isfinite(core.radius)) return 0;
  const Numbering& numbering = assembly_.numbering;
  double farthest = 0.0, turned = (end.rotation - begin.rotation).norm();
  const Vector3d shift = end.origin - begin.origin;
  for (int i = 0; i < numbering.vertices; ++i) {
    const Vector3d from = at_node(step.start, numbering.node[i]),
                   to = at_node(step.x, numbering.node[i]);
    double displacement = (to - from - shift).squaredNorm();
    if (turned > 0.0)
      displacement = std::pow(std::sqrt(displacement) + turned * (from - begin.origin).norm(), 2);
    farthest = std::max(farthest, displacement);
  }
  if (std::sqrt(farthest) + circle_ < core.radius) return 0;
  const Matrix3d before = (begin.rotation * core.axes).transpose(),
                 after = (end.rotation * core.axes).transpose();
  int count = 0;
  for (std::size_t t = 0; t < nodes_.size(); t += 3) {
    Corners from, to;
    for (int c = 0; c < 3; ++c) {
      from[c] = before * (at_node(step.start, nodes_[t + c]) - begin.origin);
      to[c] = after * (at_node(step.x, nodes_[t + c]) - end.origin);
    }
    count += sim_core::passes(core, from, to);
  }
  return count;
}

// Of each node that touches a body, the work R . (change of gap n + slip): contact only takes
// energy from the motion against a body. The gap's change stands for the normal part of the motion,
// for a round face turns on the way. On a fillet, n = sum w_i n_i, it is sum w_i times
// those of the gaps. What may begin inside a body counts as on its face: letting that out is no
// work that a run may be judged by.
void StepDiagnostics::measure_contacts(const StepTaken& step, const Newton& newton,
                                       DiagnosticExtremes& out) const {
  for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
    const int b = newton.contact.touched[i];
    if (b < 0 || b >= static_cast<int>(step.at_end.size())) continue;
    const Vector3d from = at_node(step.start, i), to = at_node(step.x, i),
                   force = at_node(newton.residual, i);
    BodyContact on = newton.contact.body_contact(step.at_end, to);
    if (on.body != b) on = {gap_of(step.at_end[b], to), b};
    if (on.others[0] >= 0 && !energy_) continue;  // a start in a corner is let out of its fillet
    // The change of a gap, and the share of its normal.
    const Vector2d displacement = on.mean([&](int body) -> Vector2d {
      const Gap gap = gap_of(step.at_end[body], to);
      const double before = gap_of(step.at_start[body], from).distance;
      const bool may_be = before < 0.0 && before >= -inside_;
      return {gap.distance - (may_be ? 0.0 : before), gap.normal.dot(on.gap.normal)};
    });
    const Vector3d slip = ContactState::slip(on, from, to, step.at_start, step.at_end);
    out.contact_work +=
        std::max(0.0, force.dot(displacement[0] / displacement[1] * on.gap.normal + slip));
  }
}

// What the energy of motion and strain gains beyond the work of gravity and of what holds, bears
// and rubs the cloth.
void StepDiagnostics::measure_energy(const StepTaken& step, const Newton& newton,
                                     DiagnosticExtremes& out) {
  const Numbering& numbering = assembly_.numbering;
  double kinetic = 0.0, weight = 0.0, forces = 0.0, sizes = 0.0;
  const auto add = [&](double work) { forces += work, sizes += std::abs(work); };
  const auto displacement_of = [&](int node) -> Vector3d {
    return at_node(step.x, node) - at_node(step.start, node);
  };
  for (int i = 0; i < numbering.nodes; ++i) {
    const Vector3d displacement = displacement_of(i);
    add(displacement.dot(at_node(newton.residual, i)));
    const int vertex = numbering.vertex[i];
    if (vertex >= numbering.vertices) continue;
    kinetic += 0.5 * assembly_.mass[i] * at_node(step.v, i).squaredNorm();
    weight += assembly_.mass[i] * step.gravity.row(vertex).dot(displacement);
  }
  const double energy = kinetic + assembly_.membrane_energy + assembly_.bending_energy;
  if (energy_) {
    out.balance = energy - *energy_ - weight - forces;
    out.gain = std::max(0.0, out.balance);
    out.flow = std::abs(energy - *energy_) + std::abs(weight) + sizes;
  }
  energy_ = energy;
}

}  // namespace sim_core
