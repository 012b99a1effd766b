#include "cloth/followed_slip.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "cloth/constants.hpp"

namespace sim_core {

using Eigen::Vector3d;

namespace {

// Slip that only rounding leaves, m/s: a nanometre in a millisecond.
constexpr double still_speed = 1e-6;

// How far what a node touches has carried the place where it began the step, at each time of the
// path, in the plane of contact, m.
std::vector<Vector3d> ways_of_support(int node, const BodyContact& on, const Vector3d& n,
                                      const SolvedStep& step) {
  const SupportPath& path = step.path;
  const Vector3d before = at_node(step.problem.start, node);
  std::vector<Vector3d> ways;
  const auto add = [&](const Vector3d& way) { ways.push_back(way - way.dot(n) * n); };
  if (on.body < static_cast<int>(step.problem.at_end.size())) {
    for (const std::vector<Body>& bodies : path.bodies) {
      const auto way = [&](int b) -> Vector3d {
        return carried(path.bodies[0][b], bodies[b], before) - before;
      };
      add(on.mean(way));
    }
    return ways;
  }
  const SmoothContact& surfaces = *step.newton.contact.surfaces;
  const Projection& at = surfaces.projection(node);
  const std::array<int, 3>& corners = surfaces.triangles()[at.triangle];
  for (const Points3& points : path.surfaces) {
    Vector3d way = Vector3d::Zero();
    for (int k = 0; k < 3; ++k) {
      const int row = step.numbering.vertex[corners[k]] - step.numbering.vertices;
      way += at.weights[k] * (points.row(row) - path.surfaces[0].row(row)).transpose();
    }
    add(way);
  }
  return ways;
}

// The way of a support in the plane of contact: as far as to each of equal times of the length h,
// the last of which is after the step, m.
struct SupportWays {
  std::vector<Vector3d> at;
  double h;  // s

  std::size_t parts() const { return at.size() - 2; }
  // Velocity at a time but the last, m/s.
  Vector3d velocity(std::size_t k) const {
    if (k == 0) return (-1.5 * at[0] + 2.0 * at[1] - 0.5 * at[2]) / h;
    return 0.5 * (at[k + 1] - at[k - 1]) / h;
  }
  // Its rate at a time but the first and the last, m/s^2.
  Vector3d gain(std::size_t k) const { return (at[k + 1] - 2.0 * at[k] + at[k - 1]) / (h * h); }
  double largest_gain() const {
    double largest = 0.0;
    for (std::size_t k = 1; k <= parts(); ++k) largest = std::max(largest, gain(k).norm());
    return largest;
  }
  // Whether the support is set off after a time but the first and the last, so fast that friction
  // may not follow: at which instant is unknown.
  bool sets_off(std::size_t k, double most) const {
    if (k + 1 > parts()) return false;
    const Vector3d now = gain(k), next = gain(k + 1);
    const double larger = std::max(now.norm(), next.norm());
    return larger > most && (next - now).norm() > shaken::set_off * larger;
  }
};

// A part of a step, in the plane of contact.
struct Part {
  Vector3d begins, ends;  // velocity of the support, m/s
  Vector3d other;         // acceleration by all forces but friction, m/s^2
  double most;            // acceleration by the largest friction, m/s^2
  double length;          // s
};

// Velocity at the end of a part of cloth that has the velocity v at its start, m/s.
Vector3d after_part(const Part& part, Vector3d v) {
  const Vector3d gain = (part.ends - part.begins) / part.length, slip = v - part.begins;
  double left = part.length;
  // Friction that turns within the part turns where the slip is zero.
  if (slip.norm() > still_speed) {
    const Vector3d friction = -part.most * slip.normalized();
    const double slowing = -(part.other + friction - gain).dot(slip.normalized());
    const double until = slowing > 0.0 ? slip.norm() / slowing : HUGE_VAL;
    v += std::min(until, left) * (part.other + friction);
    if (until >= left) return v;
    left -= until;
  }
  const Vector3d needed = gain - part.other;
  if (needed.norm() <= part.most) return part.ends;
  return v + left * (part.other + part.most * needed.normalized());
}

// The contact of a node with a body at the end of the step, or with a surface.
BodyContact contact_of(int node, const SolvedStep& step) {
  const ContactState& contact = step.newton.contact;
  BodyContact on;
  on.body = contact.touched[node];
  const bool is_surface = on.body >= static_cast<int>(step.problem.at_end.size());
  if (on.body < 0 || is_surface) return on;
  return contact.body_contact(step.problem.at_end, at_node(step.x, node), node);
}

// Goes through the parts of a step with the velocity v at its start.
void go_through(const SupportWays& support, Part part, Vector3d v, FollowedSlip& out,
                Vector3d& displacement) {
  const double h = part.length;
  for (std::size_t k = 0; k < support.parts(); ++k) {
    const Vector3d before = v;
    part.begins = support.velocity(k);
    part.ends = support.velocity(k + 1);
    v = after_part(part, before);
    displacement += 0.5 * h * (before + v);
    out.gain = (v - before) / h;
    // Cloth that slides faster than that does not feel when its support is set off.
    const double slip = (before - part.begins).norm();
    if (k > 0 && support.sets_off(k, part.most) && slip <= 2.0 * h * support.gain(k + 1).norm())
      out.uncertain = h * part.most;
  }
  out.velocity = v;
}

}  // namespace

FollowedSlip follow_slip(int node, const SolvedStep& step) {
  const ContactState& contact = step.newton.contact;
  FollowedSlip out;
  if (contact.mode[node] == contact_open) return out;
  const Vector3d n = at_node(contact.normal, node).cast<double>();
  const Vector3d force = at_node(step.newton.residual, node);
  const double normal_force = force.dot(n), mass = step.mass[node];
  const BodyContact on = contact_of(node, step);
  // What two bodies grip follows both.
  if (on.body < 0 || on.opposite >= 0 || !(normal_force > 0.0)) return out;
  const auto along = [&](const Vector3d& v) -> Vector3d { return v - v.dot(n) * n; };
  const Vector3d x = at_node(step.x, node), friction = along(force);
  const double mu = contact.mu_at(node, on, x, friction, step.problem.at_end).mu;
  const double most = mu * normal_force / mass;
  const double dt = step.problem.dt, h = dt / step.path.parts();
  const SupportWays support{ways_of_support(node, on, n, step), h};
  if (support.largest_gain() <= shaken::followed_from * most) return out;

  const Vector3d way = along(x - at_node(step.problem.start, node));
  const Vector3d before = along(step.velocities.before(node));
  const Vector3d acceleration = (way / dt - before) / step.velocities.interval(node, dt);
  const Part part{Vector3d::Zero(), Vector3d::Zero(), acceleration - friction / mass, most, h};
  Vector3d displacement = Vector3d::Zero();
  go_through(support, part, along(at_node(step.velocities.at_end, node)), out, displacement);
  out.applies = true;
  out.normal = n;
  out.misplaced = (displacement - way).norm();
  return out;
}

}  // namespace sim_core
