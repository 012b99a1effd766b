// Which cone bounds the friction of a node with a body or a surface: friction_cones.hpp has the
// rules.
#include <algorithm>

#include "contact/state.hpp"

namespace sim_core {

using Eigen::Vector3d;

void ContactState::begin(const Buffer<double>& expected, const std::vector<Body>& at_end) {
  const auto differs = [](const Body& body) {
    return !body.mu_static.empty() && body.mu_static != body.mu;
  };
  resting_.applies =
      std::any_of(at_end.begin(), at_end.end(), differs) || (surfaces && surfaces->has_static());
  if (!resting_.applies) return;
  resting_.expected = &expected;
  resting_.of.assign(mode.size(), -1);
  resting_.onward.assign(mode.size(), 0.0);
  std::fill(cone.begin(), cone.end(), Cone::sliding);
}

bool ContactState::has_static(int node, const BodyContact& on,
                              const std::vector<Body>& at_end) const {
  const auto mu_of = [&](Cone of) -> double {
    if (on.body >= static_cast<int>(at_end.size())) return surfaces->mu(node, of);
    return on.average([&](int b) { return at_end[b].mu_of(sheet[node], of); });
  };
  return mu_of(Cone::resting) > mu_of(Cone::sliding);
}

Vector3d ContactState::slip_to(int node, const BodyContact& on, const Vector3d& before,
                               const Vector3d& p, const std::vector<Body>& at_start,
                               const std::vector<Body>& at_end) const {
  if (on.body < static_cast<int>(at_end.size())) return slip(on, before, p, at_start, at_end);
  const Vector3d u = surfaces->slip(node, before, p);
  return u - u.dot(on.gap.normal) * on.gap.normal;
}

void ContactState::choose_cone(int node, const BodyContact& on, const Buffer<double>& x,
                               const Buffer<double>& start, const std::vector<Body>& at_start,
                               const std::vector<Body>& at_end) {
  const Vector3d before = at_node(start, node);
  const Vector3d way =
      slip_to(node, on, before, at_node(*resting_.expected, node), at_start, at_end);
  if (resting_.of[node] != on.body) {
    resting_.of[node] = on.body;
    const bool touched_it = !resting_.mode.empty() && resting_.mode[node] != contact_open &&
                            resting_.touched[node] == on.body;
    cone[node] = touched_it ? cone_after(resting_.mode[node]) : cone_of_new(way);
    // With one coefficient there is one cone.
    if (!has_static(node, on, at_end)) cone[node] = Cone::released;
  }
  resting_.onward[node] = slip_to(node, on, before, at_node(x, node), at_start, at_end).dot(way);
}

bool ContactState::switch_cones() {
  bool any = false;
  if (!resting_.applies) return any;
  for (std::size_t i = 0; i < mode.size(); ++i) {
    const Cone next = next_cone(cone[i], mode[i], resting_.onward[i]);
    any = any || next != cone[i];
    cone[i] = next;
  }
  return any;
}

}  // namespace sim_core
