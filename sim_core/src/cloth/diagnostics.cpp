#include <Eigen/LU>
#include <algorithm>
#include <array>
#include <cmath>

#include "cloth/stepping.hpp"
#include "math/refusal.hpp"

namespace sim_core {

using Eigen::Matrix2d;
using Eigen::Matrix3d;
using Eigen::Vector2d;
using Eigen::Vector3d;
using Eigen::Vector4d;

namespace {

// By how far flat triangles with a circle of radius `circle` around them sink into a body of radius
// `radius`, on whose face their corners are.
double sagitta(double radius, double circle) {
  return radius - std::sqrt(std::max(0.0, radius * radius - circle * circle));
}

// The contact of a node that touches body b, at the end of a step.
BodyContact contact_with(const Newton& newton, const std::vector<Body>& bodies, int b,
                         const Vector3d& p, int node) {
  const BodyContact on = newton.contact.body_contact(bodies, p, node);
  return on.body == b ? on : BodyContact{gap_of(bodies[b], p), b};
}

// Cloth turns at nodes, by an angle a where the face of a body of radius R turns by it along a cell
// h: sin(a/2) = h/(2 R). Friction would be off by up to a^2/8 of itself. At nodes it is corrected
// for that (contact/capstan.hpp), and strips over rods, box edges and meshes are then off by less
// than a^4/75, down to R of 0.9 cells: at most 1.3 % there, where a^4/75 is 2.6 %. Below 0.7 cells
// the correction vouches for nothing.
constexpr double corrected_to = 0.7;  // h/(2 R)

double corrected_error(double lean) {
  const double turn = 2.0 * std::asin(std::min(1.0, lean));
  return lean <= corrected_to ? std::pow(turn, 4) / 75.0 : std::min(1.0, turn * turn / 8.0);
}

double angle_between(const Vector3d& a, const Vector3d& b) {
  return std::atan2(a.cross(b).norm(), a.dot(b));
}

bool is_inside(const Vector4d& weights) { return (weights.tail<3>().array() != 0.0).all(); }

// Smallest angle of a direction with the normals of the triangles that have these nodes, but for
// one with all of `left_out`, rad.
double angle_with_triangles(const Surface& surface, const std::vector<int>& nodes,
                            const std::array<int, 3>& left_out, const Buffer<double>& x,
                            const Vector3d& direction) {
  double least = HUGE_VAL;
  const auto has = [](const std::array<int, 3>& triangle, int node) {
    return std::find(triangle.begin(), triangle.end(), node) != triangle.end();
  };
  for (int k = surface.around_begin[nodes[0]]; k < surface.around_begin[nodes[0] + 1]; ++k) {
    const std::array<int, 3>& triangle = surface.triangles[surface.around[k]];
    const auto in_triangle = [&](int node) { return has(triangle, node); };
    const bool is_left_out = std::all_of(left_out.begin(), left_out.end(), in_triangle);
    if (is_left_out || !std::all_of(nodes.begin(), nodes.end(), in_triangle)) continue;
    const Vector3d a = at_node(x, triangle[0]), b = at_node(x, triangle[1]),
                   c = at_node(x, triangle[2]);
    const double angle = angle_between((b - a).cross(c - a), direction);
    least = std::min({least, angle, M_PI - angle});
  }
  return least;
}

// By how much the normal of a pair differs from those of the triangles from which it came, rad:
// infinite where it came from none. `start`: its weights when the step began.
//
// Within a triangle the normal is that of the triangle, and does not turn however far the pair
// slides. Where the closest point was at a border of it, the pair came from the triangle beyond.
// The direction to the border then says how far away that is, and not how far the sheet turns.
double angle_of_arrival(const StepTaken& step, const ContactSet& pairs, const Pair& pair,
                        const Vector4d& start) {
  const std::array<int, 4>& node = pair.stencil.node;
  const Surface& surface = pairs.near.surface;
  const auto angle_with = [&](const std::vector<int>& nodes, const std::array<int, 3>& left_out) {
    return angle_with_triangles(surface, nodes, left_out, step.x, pair.contact.normal);
  };
  if (pair.stencil.kind == PairKind::vertex_triangle) {
    if (is_inside(start)) return is_inside(pair.weights) ? 0.0 : HUGE_VAL;
    std::vector<int> border;
    for (int c = 1; c < 4; ++c) {
      if (start[c] != 0.0) border.push_back(node[c]);
    }
    return angle_with(border, {node[1], node[2], node[3]});
  }
  double least = HUGE_VAL;
  for (int c = 0; c < 4; ++c) {
    // The other end of the same edge has no weight.
    if (start[c ^ 1] == 0.0) least = std::min(least, angle_with({node[c]}, {-1, -1, -1}));
  }
  return least;
}

}  // namespace

StepDiagnostics::StepDiagnostics(const ClothMesh& mesh, const Assembly& assembly)
    : assembly_(assembly), cell_(mesh.rest.rows(), 0.0) {
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
  measure_friction(step, newton, out);
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
    const Vector3d from = at_node(step.start, i), to = at_node(step.x, i);
    const BodyContact on = contact_with(newton, step.at_end, b, to, i);
    // An opposite body may push cloth to the face that it touches, as a spring does.
    const Vector3d force = at_node(newton.residual, i) - newton.contact.press(on, i);
    // A start in a corner is let out of its fillet.
    if (on.neighbours[0] >= 0 && !energy_) continue;
    // The change of a gap, and the share of its normal.
    const Vector2d displacement = on.mean([&](int body) -> Vector2d {
      const Gap gap = gap_of(step.at_end[body], to);
      const double before = gap_of(step.at_start[body], from).distance;
      const bool may_be = before < 0.0 && before >= -inside_depth;
      return {gap.distance - (may_be ? 0.0 : before), gap.normal.dot(on.gap.normal)};
    });
    const Vector3d slip = ContactState::slip(on, from, to, step.at_start, step.at_end);
    out.contact_work +=
        std::max(0.0, force.dot(displacement[0] / displacement[1] * on.gap.normal + slip));
  }
}

// The normals half a cell behind and ahead of a node lean by b from each other's mean, and tan b =
// h/(2 R). The correction is right where tension along friction presses, and where a difference of
// that tension carries friction away. So it counts as an error as far as weight, inertia and other
// cloth press, and as far as the face is round across friction, too: there tension across presses,
// and shear may carry friction away, as in a sheet under which a ball turns. Of a rod the product
// of the curvatures is 0, wherever friction points; of a ball it is the square of that along
// friction.
double StepDiagnostics::node_error(const StepTaken& step, const Newton& newton, int node,
                                   const BodyContact& on, const Vector3d& slip) const {
  const Vector3d p = at_node(step.x, node), along = -slip.normalized(), n = on.gap.normal;
  const Vector3d half_cell = 0.5 * cell_[assembly_.numbering.vertex[node]] * along;
  const auto normal_at = [&](const Vector3d& near) -> Vector3d {
    return on.body < static_cast<int>(step.at_end.size())
               ? gap_of(step.at_end[on.body], near).normal
               : newton.contact.surfaces->normal_near(node, near);
  };
  const Vector3d behind = normal_at(p - half_cell), ahead = normal_at(p + half_cell);
  const double error = corrected_error(std::tan(0.5 * angle_between(behind, ahead)));
  // Normals of meshes are too rough for their curvature across friction.
  if (on.body >= static_cast<int>(step.at_end.size())) return error;
  const auto mu_along = [&](const Vector3d& friction) {
    return newton.contact.mu_at(node, on, p, friction, step.at_end).mu;
  };
  const double mu = mu_along(Vector3d::Zero()), corrected = mu_along(along);
  if (!(corrected < mu)) return error;
  const Vector3d aside = n.cross(half_cell), turn = ahead - behind;
  const Vector3d turn_aside = normal_at(p + aside) - normal_at(p - aside);
  const double both_ways = n.dot(turn.cross(turn_aside)) / turn.squaredNorm();
  const double elastic = at_node(assembly_.gradient, node).dot(n);
  const double tension = elastic / std::max(elastic, at_node(newton.residual, node).dot(n));
  const double right = elastic > 0.0 ? tension * (1.0 - std::clamp(both_ways, 0.0, 1.0)) : 0.0;
  return std::min(1.0, error + (1.0 - corrected / mu) * (1.0 - right));
}

// Pairs are not corrected. Their normal turns as they slide, and by a along a cell.
double StepDiagnostics::pair_error(const StepTaken& step, ContactSet& pairs,
                                   const Pair& pair) const {
  const FourPoints at = points_of(pair.stencil, step.start);
  const Vector4d start = closest_weights(pair.stencil.kind, at);
  const Vector3d before = pairs.turn_of(pair.stencil, pair.weights) * between_closest(start, at);
  const double angle = std::min(angle_between(before, pair.contact.normal),
                                angle_of_arrival(step, pairs, pair, start));
  double cell = 0.0;
  for (int node : pair.stencil.node) {
    const int vertex = assembly_.numbering.vertex[node];
    if (vertex < assembly_.numbering.vertices) cell = std::max(cell, cell_[vertex]);
  }
  const double turn = angle * cell / pair.contact.slip.norm();
  return std::min(1.0, turn * turn / 8.0);
}

// Of all that slides: nodes on bodies and surfaces, and pairs of cloth with other cloth and
// surfaces. Pairs within a sheet are left out: no scene is known that they spoil.
void StepDiagnostics::measure_friction(const StepTaken& step, const Newton& newton,
                                       DiagnosticExtremes& out) const {
  const int bodies = static_cast<int>(step.at_end.size());
  const int touching =
      newton.pairs ? static_cast<int>(newton.pairs->materials.thickness.size()) : 0;
  out.friction.assign(bodies + touching, {});
  const auto count = [&](int other, double work, double error) {
    out.friction[other].work += work;
    out.friction[other].error += work * error;
  };
  for (int i = 0; i < assembly_.numbering.free_nodes; ++i) {
    const int b = newton.contact.touched[i];
    if (newton.contact.mode[i] != contact_slip || b < 0) continue;
    const Vector3d from = at_node(step.start, i), to = at_node(step.x, i);
    const Vector3d n = at_node(newton.contact.normal, i).cast<double>();
    BodyContact on{{0.0, n}, b};
    Vector3d slip;
    if (b < bodies) {
      on = contact_with(newton, step.at_end, b, to, i);
      slip = ContactState::slip(on, from, to, step.at_start, step.at_end);
    } else {
      slip = newton.contact.surfaces->slip(i, from, to);
      slip -= slip.dot(n) * n;
    }
    const double work = std::abs(at_node(newton.residual, i).dot(slip));
    // On a fillet cloth does not turn round anything.
    const bool hollow = on.neighbours[0] >= 0;
    if (work > 0.0) count(b, work, hollow ? 0.0 : node_error(step, newton, i, on, slip));
  }
  if (!newton.pairs) return;
  const ContactMaterials& materials = newton.pairs->materials;
  const std::vector<int>& sheet_of_node = newton.pairs->near.surface.sheet_of_node;
  const int surfaces = touching - materials.sheets;
  for (const Pair& pair : newton.pairs->list()) {
    const int a = sheet_of_node[pair.stencil.node[0]], b = sheet_of_node[pair.stencil.node[3]];
    const double work = std::abs(pair.contact.force.dot(pair.contact.slip));
    if (a == b || !(work > 0.0)) continue;
    const int last = std::max(a, b);
    const int other =
        last >= materials.sheets ? bodies + last - materials.sheets : bodies + surfaces + last;
    count(other, work, pair_error(step, *newton.pairs, pair));
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
