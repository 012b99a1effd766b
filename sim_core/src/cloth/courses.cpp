// How nodes moved in a step, by their contacts.
#include "cloth/constants.hpp"
#include "cloth/stepping.hpp"

namespace sim_core {

// How the nodes moved in the step that was solved.
Courses Stepper::courses() const {
  const Numbering& numbering = assembly_.numbering;
  Courses out{std::vector<Course>(numbering.nodes, Course::bound),
              Buffer<double>(4L * numbering.nodes, 0.0), Buffer<double>(4L * numbering.nodes, 0.0),
              std::vector<char>(numbering.nodes, 0), std::vector<char>(numbering.nodes, 0)};
  for (int i = 0; i < numbering.free_nodes; ++i) {
    if (newton.contact.mode[i] == contact_open) out.of_node[i] = Course::free;
    if (newton.contact.mode[i] == contact_stick) at_node(out.gain, i) = turns_.gain(i);
    if (newton.contact.mode[i] != contact_slip) continue;
    out.of_node[i] = Course::sliding;
    at_node(out.support, i) = turns_.support(i);
    out.outrun[i] = turns_.outruns(i);
  }
  for (int i = 0; i < numbering.free_nodes; ++i) {
    out.followed[i] = turns_.followed(i).applies;
    if (out.followed[i]) at_node(out.gain, i) = turns_.followed(i).gain;
  }
  if (!newton.pairs) return out;
  for (const Pair& pair : newton.pairs->list()) {
    if (pair.contact.force.isZero(0.0)) continue;
    bool is_cloth = true;
    for (int node : pair.stencil.node) {
      if (pair.row.mode != contact_slip) out.of_node[node] = Course::bound;
      if (out.of_node[node] == Course::free) out.of_node[node] = Course::sliding;
      is_cloth = is_cloth && assembly_.mass[node] > 0.0;
    }
    out.pushes_itself = out.pushes_itself || is_cloth;
  }
  return out;
}

double Stepper::turn_error(double dt, const BoundaryConditions& drive, double lasts) {
  const StepProblem problem{dt, drive.damping, start_, inertia_, bodies_before_, drive.bodies};
  return turns_.error(solved(problem), lasts);
}

double Stepper::landing_way(double dt, const BoundaryConditions& drive) {
  const StepProblem problem{dt, drive.damping, start_, inertia_, bodies_before_, drive.bodies};
  return landings_.largest_way(solved(problem));
}

// How far bodies and surfaces push out what begins a step inside them, or nearer than it may be, m.
Eigen::Vector3d Stepper::depenetration(int node, const std::vector<Body>& at_start) const {
  Eigen::Vector3d out = Eigen::Vector3d::Zero();
  if (node >= assembly_.numbering.free_nodes) return out;
  if (newton.contact.surfaces && newton.contact.mode[node] != contact_open)
    out = newton.contact.surfaces->depenetration(node, at_node(start_, node), inside_depth);
  const Gap gap = newton.contact.body_contact(at_start, at_node(start_, node)).gap;
  if (gap.distance < -inside_depth) out -= gap.distance * gap.normal;
  return out;
}

}  // namespace sim_core
