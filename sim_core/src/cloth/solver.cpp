#include "cloth/solver.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "cloth/mesh.hpp"
#include "cloth/stepping.hpp"
#include "kernel_levels.hpp"
#include "math/refusal.hpp"

namespace sim_core {

struct ClothSolver::Impl {
  const ClothMesh mesh;
  const SurfaceMeshes& surfaces;
  const ContactMaterials materials;
  Assembly assembly;
  Stepper stepper;
  StepController controller;
  Newton& newton;
  const Numbering& numbering;

  explicit Impl(const ClothSetup& setup)
      : mesh(setup.rest, setup.triangles),
        surfaces(setup.surfaces),
        materials(setup.touch),
        assembly(kernel_level(setup.kernel).cloth, mesh, Fabrics(mesh, setup.fabrics), setup.held,
                 static_cast<int>(surfaces.surface_of_vertex.size())),
        stepper(mesh, assembly, setup.settings),
        controller(stepper, setup.control),
        newton(stepper.newton),
        numbering(assembly.numbering) {
    stepper.sheets = mesh.sheets;
    const std::vector<double> cells = cells_of_vertices(mesh);
    const std::vector<double> areas = areas_of_vertices(mesh);
    for (int i = 0; i < numbering.free_nodes; ++i) {
      const int vertex = numbering.vertex[i];
      const int sheet = mesh.sheet_of_vertex[vertex];
      newton.contact.sheet[i] = sheet;
      newton.contact.cell[i] = cells[vertex];
      newton.contact.area[i] = areas[vertex];
      newton.contact.thickness[i] = materials.thickness[sheet];
    }
    if ((materials.mu.array() >= 0.0).any()) {
      newton.pairs = contact_set_of(mesh, numbering, materials, surfaces);
    }
    if (numbering.surface_vertices > 0) {
      newton.contact.surfaces = smooth_contact_of(mesh, numbering, materials, surfaces);
    }
  }

  void load(const Points3& positions, Buffer<double>& into) const {
    if (positions.rows() != numbering.vertices)
      refuse("positions: must have a row for each vertex");
    if (!positions.allFinite()) refuse("positions: must be finite");
    for (int i = 0; i < numbering.vertices; ++i)
      at_node(into, numbering.node[i]) = positions.row(i).transpose();
  }

  // The state with other positions.
  Buffer<double> at(const Points3& positions) const {
    Buffer<double> out = stepper.x;
    load(positions, out);
    return out;
  }

  void load_surfaces(const Points3& positions, Buffer<double>& into) const {
    if (positions.rows() != numbering.surface_vertices)
      refuse("surfaces: must keep their vertices");
    if (!positions.allFinite()) refuse("surfaces: positions must be finite");
    for (int i = 0; i < numbering.surface_vertices; ++i)
      at_node(into, surface_node(i)) = positions.row(i).transpose();
  }

  int surface_node(int i) const { return numbering.node[numbering.vertices + i]; }

  // Whether the cloth crosses anything that it touches.
  bool crosses(const Points3& positions, const Points3& of_surfaces) const {
    Points3 points(positions.rows() + of_surfaces.rows(), 3);
    points << positions, of_surfaces;
    Triangles all(mesh.triangles.rows() + surfaces.triangles.rows(), 3);
    all << mesh.triangles,
        (surfaces.triangles.array() + static_cast<std::int32_t>(positions.rows())).matrix();
    int unfelt = self_intersections(of_surfaces, surfaces.triangles);
    if (!(materials.mu(0, 0) >= 0.0)) unfelt += self_intersections(positions, mesh.triangles);
    return self_intersections(points, all) > unfelt;
  }

  // What a free node that touches a body sees of the bodies; none where it touches none.
  BodyContact contact_at_end(int node) const {
    const std::vector<Body>& bodies = stepper.bodies();
    const int touched = newton.contact.touched[node];
    if (touched < 0 || touched >= static_cast<int>(bodies.size())) return {};
    const BodyContact on = newton.contact.body_contact(bodies, at_node(stepper.x, node), node);
    return on.body == touched ? on : BodyContact{};
  }

  Points3 unload(const Buffer<double>& from) const {
    Points3 out(numbering.vertices, 3);
    for (int i = 0; i < numbering.vertices; ++i)
      out.row(i) = at_node(from, numbering.node[i]).transpose();
    return out;
  }
};

ClothSolver::ClothSolver(const ClothSetup& setup)
    : setup_(setup), impl_(std::make_unique<Impl>(setup_)) {}
ClothSolver::~ClothSolver() = default;

void ClothSolver::set_state(const Points3& positions, const Points3& velocities,
                            const Points3& surfaces, const std::vector<Body>& bodies, bool begins) {
  impl_->load(positions, impl_->stepper.x);
  impl_->load_surfaces(surfaces, impl_->stepper.x);
  if (impl_->newton.pairs && impl_->crosses(positions, surfaces)) {
    refuse(
        "positions: must not cross a surface, and under self-contact cloth must not cross itself");
  }
  impl_->load(velocities, impl_->stepper.velocities.at_end);
  impl_->stepper.restart({});
  begin(bodies, begins);
  impl_->controller.restart();
}

// Before a first step: refuses bodies that are sharp against a cell, and free vertices inside one
// where the scene `begins`.
void ClothSolver::begin(const std::vector<Body>& bodies, bool begins) {
  refuse_sharp(bodies, cell_of(impl_->mesh));
  if (begins) impl_->stepper.refuse_inside(bodies);
  impl_->stepper.restart(bodies);
}

StepReport ClothSolver::step(double dt, const Points3& gravity, const Points3& held,
                             const Points3& surfaces, const std::vector<Body>& bodies,
                             double damping, const std::vector<DriveRates>& rates) {
  if (!impl_->stepper.started()) refuse_sharp(bodies, cell_of(impl_->mesh));
  constexpr int unlimited = std::numeric_limits<int>::max();
  return impl_->stepper.step(dt, {gravity, held, surfaces, bodies, damping, rates}, unlimited);
}

void ClothSolver::follow(const std::vector<SensitivityParameter>& parameters) {
  for (const SensitivityParameter& parameter : parameters) {
    for (const SensitivityTerm& term : parameter)
      refuse_unknown(term, impl_->materials.mu, impl_->mesh.sheets);
  }
  impl_->stepper.sensitivities.follow(parameters);
}

std::vector<Points3> ClothSolver::position_sensitivities() const {
  const Sensitivities& sensitivities = impl_->stepper.sensitivities;
  std::vector<Points3> out;
  for (int p = 0; p < sensitivities.count(); ++p)
    out.push_back(impl_->unload(sensitivities.positions(p)));
  return out;
}

std::vector<Points3> ClothSolver::velocity_sensitivities() const {
  const Sensitivities& sensitivities = impl_->stepper.sensitivities;
  std::vector<Points3> out;
  for (int p = 0; p < sensitivities.count(); ++p)
    out.push_back(impl_->unload(sensitivities.velocities(p)));
  return out;
}

void ClothSolver::set_sensitivities(const std::vector<Points3>& x, const std::vector<Points3>& v) {
  Sensitivities& sensitivities = impl_->stepper.sensitivities;
  if (static_cast<int>(x.size()) != sensitivities.count() || v.size() != x.size())
    refuse("sensitivities: must be one of each parameter");
  const Buffer<double> zero(4L * impl_->numbering.nodes, 0.0);
  for (int p = 0; p < sensitivities.count(); ++p) {
    Buffer<double> positions = zero, velocities = zero;
    impl_->load(x[p], positions);
    impl_->load(v[p], velocities);
    sensitivities.set_state(p, positions, velocities);
  }
}

std::vector<double> ClothSolver::nearest_events() const {
  const Sensitivities& sensitivities = impl_->stepper.sensitivities;
  std::vector<double> out;
  for (int p = 0; p < sensitivities.count(); ++p) out.push_back(sensitivities.nearest_event(p));
  return out;
}

SensitivityReport ClothSolver::sensitivity_report() const {
  return impl_->stepper.sensitivities.report();
}

StepReport ClothSolver::advance(double& time, double event, const PrescribedMotion& motion,
                                bool may_fail) {
  if (!impl_->stepper.started()) begin(motion.conditions(time).bodies);
  impl_->stepper.may_fail = may_fail;
  return impl_->controller.advance(time, event, motion);
}

Eigen::Vector3d ClothSolver::momentum_rate() const { return impl_->stepper.momentum_rate(); }

Eigen::Vector3d ClothSolver::damping_force() const { return impl_->stepper.damping_force(); }

Points3 ClothSolver::positions() const { return impl_->unload(impl_->stepper.x); }
Points3 ClothSolver::velocities() const { return impl_->unload(impl_->stepper.velocities.at_end); }
Points3 ClothSolver::reactions() const { return impl_->unload(impl_->newton.residual); }

std::vector<std::int32_t> ClothSolver::contacts() const {
  const Numbering& numbering = impl_->numbering;
  std::vector<std::int32_t> out(numbering.vertices, -1);
  for (int i = 0; i < numbering.free_nodes; ++i)
    out[numbering.vertex[i]] = impl_->newton.contact.touched[i];
  return out;
}

std::vector<std::int32_t> ClothSolver::sliding() const {
  const Numbering& numbering = impl_->numbering;
  std::vector<std::int32_t> out(numbering.vertices, 0);
  for (int i = 0; i < numbering.free_nodes; ++i) {
    out[numbering.vertex[i]] = impl_->newton.contact.mode[i] == contact_slip;
  }
  return out;
}

std::vector<std::int32_t> ClothSolver::opposites() const {
  std::vector<std::int32_t> out(impl_->numbering.vertices, -1);
  for (int i = 0; i < impl_->numbering.free_nodes; ++i) {
    out[impl_->numbering.vertex[i]] = impl_->contact_at_end(i).opposite;
  }
  return out;
}

Points3 ClothSolver::opposite_forces() const {
  Points3 out = Points3::Zero(impl_->numbering.vertices, 3);
  for (int i = 0; i < impl_->numbering.free_nodes; ++i) {
    const BodyContact on = impl_->contact_at_end(i);
    if (on.opposite < 0) continue;
    const Eigen::Vector3d press = impl_->newton.contact.press(on, i);
    const Eigen::Vector3d borne = at_node(impl_->newton.residual, i) - press;
    const double normal_force = borne.dot(on.gap.normal);
    const Eigen::Vector3d friction = borne - normal_force * on.gap.normal;
    const double share = press.norm() / (std::max(normal_force, 0.0) + press.norm());
    out.row(impl_->numbering.vertex[i]) = (press + share * friction).transpose();
  }
  return out;
}

Points3 ClothSolver::surface_forces() const {
  Points3 out(impl_->numbering.surface_vertices, 3);
  for (int i = 0; i < impl_->numbering.surface_vertices; ++i) {
    out.row(i) = -at_node(impl_->newton.residual, impl_->surface_node(i)).transpose();
  }
  const ContactState& contact = impl_->newton.contact;
  for (int i = 0; i < impl_->numbering.free_nodes; ++i) {
    if (contact.touched[i] < static_cast<int>(impl_->stepper.bodies().size())) continue;
    const Projection& projection = contact.surfaces->projection(i);
    for (int k = 0; k < 3; ++k) {
      const int vertex =
          impl_->numbering.vertex[contact.surfaces->triangles()[projection.triangle][k]];
      out.row(vertex - impl_->numbering.vertices) -=
          projection.weights[k] * at_node(impl_->newton.residual, i).transpose();
    }
  }
  return out;
}

ClothSolver::PairForces ClothSolver::pair_forces() const {
  const Numbering& numbering = impl_->numbering;
  std::vector<const Pair*> acting;
  if (impl_->newton.pairs) {
    for (const Pair& pair : impl_->newton.pairs->list()) {
      if (!pair.contact.force.isZero(0.0)) acting.push_back(&pair);
    }
  }
  const auto count = static_cast<Eigen::Index>(acting.size());
  PairForces out{{count, 4}, {count, 4}, Points3(count, 3), Eigen::VectorXd(count), Truths(count)};
  for (Eigen::Index p = 0; p < count; ++p) {
    for (int c = 0; c < 4; ++c) out.vertices(p, c) = numbering.vertex[acting[p]->stencil.node[c]];
    out.weights.row(p) = acting[p]->weights.transpose();
    out.forces.row(p) = acting[p]->contact.force.transpose();
    out.distance[p] = acting[p]->contact.gap + acting[p]->thickness;
    out.sliding[p] = acting[p]->row.mode == contact_slip;
  }
  return out;
}

std::tuple<double, double, Points3> ClothSolver::energies(const Points3& positions) {
  impl_->assembly.evaluate(impl_->at(positions), false);
  const Assembly& assembly = impl_->assembly;
  return {assembly.membrane_energy, assembly.bending_energy, impl_->unload(assembly.gradient)};
}

// Inverse iteration: v <- (K + M/T^2)^-1 M v tends to the softest mode, and 1/growth - 1/T^2 to its
// eigenvalue.
double ClothSolver::lowest_eigenvalue(const Points3& positions) {
  constexpr double period = 0.3;  // T, s
  constexpr int iterations = 40;
  Assembly& assembly = impl_->assembly;
  const int free_nodes = impl_->numbering.free_nodes;
  const Buffer<double> x = impl_->at(positions);
  Inertia inertia(impl_->numbering.nodes);
  std::fill(inertia.rate.begin(), inertia.rate.end(), 1.0 / (period * period));
  assembly.set_diagonal(inertia, 0.0);
  assembly.use_convex_hessian = false;
  assembly.evaluate(x, true);
  const ContactState open(free_nodes);
  StaleFactor factor(impl_->numbering);
  factor.make(assembly, x, open, period);
  Buffer<float> v(4L * free_nodes + 64, 0.0f), y(v),
      work((2 * krylov_max + 1) * 4L * free_nodes + 64, 0.0f);
  for (int i = 0; i < free_nodes; ++i)
    at_node(v, i).setConstant(1.0f + 0.1f * static_cast<float>(i % 7));
  double value = 0.0;
  for (int iteration = 0; iteration < iterations; ++iteration) {
    double size = 0.0, growth = 0.0;
    for (int i = 0; i < free_nodes; ++i)
      size += assembly.mass[i] * at_node(v, i).cast<double>().squaredNorm();
    const float scale = static_cast<float>(1.0 / std::sqrt(size));
    for (float& component : v) component *= scale;
    Buffer<float> force = v;
    for (int i = 0; i < free_nodes; ++i) at_node(force, i) *= static_cast<float>(assembly.mass[i]);
    std::fill(y.begin(), y.end(), 0.0f);
    assembly.kernel.krylov(assembly.matrix, factor.view(), open.rows(), force.data(), y.data(),
                           work.data(), 1e-3);
    for (int i = 0; i < free_nodes; ++i) {
      growth += assembly.mass[i] * at_node(v, i).cast<double>().dot(at_node(y, i).cast<double>());
    }
    value = 1.0 / growth - 1.0 / (period * period);
    v = y;
  }
  return value;
}

const Eigen::VectorXd& ClothSolver::masses() const { return impl_->assembly.mass_of_vertex; }
std::string ClothSolver::kernel() const { return impl_->assembly.kernel.name; }

}  // namespace sim_core
