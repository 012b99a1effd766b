#include "cloth/solver.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "cloth/control.hpp"
#include "cloth/intersections.hpp"
#include "cloth/kernels/choice.hpp"
#include "cloth/refusal.hpp"
#include "cloth/stepping.hpp"

namespace sim_core {

namespace {

// Solves with the matrix of the last evaluation, without contact.
struct LinearSolve {
  Assembly& assembly;
  ContactState open;
  StaleFactor factor;
  Buffer<float> work;

  LinearSolve(Assembly& assembly_in, const Buffer<double>& x, double dt)
      : assembly(assembly_in),
        open(assembly_in.numbering.free_nodes),
        factor(assembly_in.numbering),
        work((2 * krylov_max + 1) * 4L * assembly_in.numbering.free_nodes + 64, 0.0f) {
    factor.make(assembly, x, open, dt);
  }

  void solve(const Buffer<float>& b, Buffer<float>& x) {
    assembly.kernel.krylov(assembly.matrix, factor.view(), open.rows(), b.data(), x.data(), work.data(), krylov_max,
                           1e-3);
  }
};

// How far nodes move before pairs are looked for anew, over the side of a cell.
constexpr double margin_share = 0.25;

using Triples = std::vector<std::array<int, 3>>;

void append(const Triangles& triangles, const int* node, Triples& out) {
  for (Eigen::Index t = 0; t < triangles.rows(); ++t) {
    out.push_back({node[triangles(t, 0)], node[triangles(t, 1)], node[triangles(t, 2)]});
  }
}

// Throws std::invalid_argument, naming the field, where the cloth would feel itself at rest.
void check_thickness(const ClothMesh& mesh, const std::vector<int>& sheets, const PairSettings& settings) {
  Buffer<double> rest(4L * mesh.rest.rows(), 0.0);
  for (Eigen::Index i = 0; i < mesh.rest.rows(); ++i) at_node(rest, i).head<2>() = mesh.rest.row(i).transpose();
  std::vector<int> vertices(mesh.rest.rows());
  std::iota(vertices.begin(), vertices.end(), 0);
  Triples triangles;
  append(mesh.triangles, vertices.data(), triangles);
  const Eigen::Index count = settings.mu.rows();
  Felt felt = Felt::Constant(count, count, false);  // sheets lie somewhere at rest, not on each other
  for (Eigen::Index s = 0; s < count; ++s) felt(s, s) = settings.mu(s, s) >= 0.0;
  const double reach = *std::max_element(settings.thickness.begin(), settings.thickness.end());
  for (const Candidate& pair : candidates(Surface(triangles, sheets, felt), rest, reach)) {
    const FourPoints at = points_of(pair, rest);
    const double thickness = settings.thickness[sheets[pair.node[0]]];
    if (between_closest(closest_weights(pair.kind, at), at).norm() > thickness) continue;
    refuse(text("thickness: must be less than the distance at rest of vertices and edges that do not meet, and vertex ",
                pair.node[0], " is nearer to one than ", thickness, " m"));
  }
}

// Sheets, and after them surfaces; -1 of slopes.
std::vector<int> sheets_of_nodes(const ClothMesh& mesh, const Numbering& numbering, const SurfaceMeshes& surfaces) {
  const std::vector<int> sheets = mesh.sheets();
  const int count = 1 + *std::max_element(sheets.begin(), sheets.end());
  std::vector<int> out(numbering.nodes, -1);
  for (int i = 0; i < numbering.vertices; ++i) out[numbering.node[i]] = sheets[i];
  const int* others = numbering.node.data() + numbering.vertices + numbering.slopes;
  for (int i = 0; i < numbering.others; ++i) out[others[i]] = count + surfaces.surface_of_vertex[i];
  return out;
}

std::unique_ptr<Pairs> pairs_of(const ClothMesh& mesh, const Numbering& numbering, const PairSettings& settings,
                                const SurfaceMeshes& surfaces) {
  check_thickness(mesh, mesh.sheets(), settings);
  Triples triangles;
  append(mesh.triangles, numbering.node.data(), triangles);
  append(surfaces.triangles, numbering.node.data() + numbering.vertices + numbering.slopes, triangles);
  Surface surface(std::move(triangles), sheets_of_nodes(mesh, numbering, surfaces),
                  (settings.mu.array() >= 0.0).matrix());
  const double cell = std::sqrt(2.0 * mesh.area.mean());
  return std::make_unique<Pairs>(std::move(surface), settings, margin_share * cell, numbering.free_nodes);
}

// Radius of the smallest circle around a triangle at rest, m: its circumcircle, or that of its longest side.
double circle_around(const ClothMesh& mesh, Eigen::Index triangle) {
  std::array<double, 3> side;
  for (int c = 0; c < 3; ++c) {
    side[c] =
        (mesh.rest.row(mesh.triangles(triangle, c)) - mesh.rest.row(mesh.triangles(triangle, (c + 1) % 3))).norm();
  }
  std::sort(side.begin(), side.end());
  const auto [a, b, c] = side;
  return c * c >= a * a + b * b ? 0.5 * c : a * b * c / (4.0 * mesh.area[triangle]);
}

std::unique_ptr<SmoothContact> smooth_of(const ClothMesh& mesh, const Numbering& numbering,
                                         const PairSettings& settings, const SurfaceMeshes& surfaces) {
  Buffer<double> x(4L * numbering.nodes, 0.0);
  const int* others = numbering.node.data() + numbering.vertices + numbering.slopes;
  for (int i = 0; i < numbering.others; ++i) at_node(x, others[i]) = surfaces.positions.row(i).transpose();
  Triples triangles;
  append(surfaces.triangles, others, triangles);
  std::vector<double> radius(numbering.free_nodes, 0.0);
  for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
    const double own = circle_around(mesh, t);
    for (int c = 0; c < 3; ++c) {
      const int node = numbering.node[mesh.triangles(t, c)];
      if (node < numbering.free_nodes) radius[node] = std::max(radius[node], own);
    }
  }
  return std::make_unique<SmoothContact>(std::move(triangles), sheets_of_nodes(mesh, numbering, surfaces), settings,
                                         surfaces.crease, x, radius);
}

}  // namespace

struct ClothSolver::Impl {
  const ClothMesh mesh;
  const SurfaceMeshes surfaces;
  const bool feels_itself;
  Assembly assembly;
  Stepper stepper;
  StepController controller;
  Newton& newton;
  const Numbering& numbering;

  Impl(const Points2& rest, const Triangles& triangles, const std::vector<ClothProperties>& fabrics,
       const std::vector<std::int32_t>& held, const Edges& clamped, const ClothSettings& settings,
       const StepControl& control, const std::string& kernel, const std::optional<PairSettings>& touch,
       const SurfaceMeshes& surfaces_in)
      : mesh(rest, triangles),
        surfaces(surfaces_in),
        feels_itself(touch && touch->mu(0, 0) >= 0.0),
        assembly(cloth_kernel_named(kernel), mesh, Fabrics(mesh, fabrics), held, clamped,
                 static_cast<int>(surfaces.surface_of_vertex.size())),
        stepper(assembly, settings),
        controller(stepper, control),
        newton(stepper.newton),
        numbering(assembly.numbering) {
    if (touch) newton.pairs = pairs_of(mesh, numbering, *touch, surfaces);
    if (numbering.others > 0) newton.contact.surfaces = smooth_of(mesh, numbering, *touch, surfaces);
  }

  void load(const Points3& positions, const Points3& slopes, Buffer<double>& into) const {
    if (positions.rows() != numbering.vertices) refuse("positions: must have a row for each vertex");
    if (slopes.rows() != numbering.slopes) refuse("slopes: must have a row for each clamped edge");
    if (!positions.allFinite() || !slopes.allFinite()) refuse("positions: must be finite");
    for (int i = 0; i < numbering.vertices; ++i) at_node(into, numbering.node[i]) = positions.row(i).transpose();
    for (int i = 0; i < numbering.slopes; ++i) {
      at_node(into, numbering.node[numbering.vertices + i]) = slopes.row(i).transpose();
    }
  }

  void load_surfaces(const Points3& positions, Buffer<double>& into) const {
    if (positions.rows() != numbering.others) refuse("surfaces: must keep their vertices");
    if (!positions.allFinite()) refuse("surfaces: positions must be finite");
    for (int i = 0; i < numbering.others; ++i) at_node(into, other(i)) = positions.row(i).transpose();
  }

  int other(int i) const { return numbering.node[numbering.vertices + numbering.slopes + i]; }

  // Whether cloth crosses what it feels.
  bool crosses(const Points3& positions, const Points3& others) const {
    Points3 points(positions.rows() + others.rows(), 3);
    points << positions, others;
    Triangles all(mesh.triangles.rows() + surfaces.triangles.rows(), 3);
    all << mesh.triangles, (surfaces.triangles.array() + static_cast<std::int32_t>(positions.rows())).matrix();
    int unfelt = self_intersections(others, surfaces.triangles);
    if (!feels_itself) unfelt += self_intersections(positions, mesh.triangles);
    return self_intersections(points, all) > unfelt;
  }

  Points3 unload(const Buffer<double>& from) const {
    Points3 out(numbering.vertices, 3);
    for (int i = 0; i < numbering.vertices; ++i) out.row(i) = at_node(from, numbering.node[i]).transpose();
    return out;
  }
};

ClothSolver::ClothSolver(const Points2& rest, const Triangles& triangles, const std::vector<ClothProperties>& fabrics,
                         const std::vector<std::int32_t>& held, const Edges& clamped, const ClothSettings& settings,
                         const StepControl& control, const std::string& kernel,
                         const std::optional<PairSettings>& touch, const SurfaceMeshes& surfaces)
    : impl_(std::make_unique<Impl>(rest, triangles, fabrics, held, clamped, settings, control, kernel, touch,
                                   surfaces)) {}
ClothSolver::~ClothSolver() = default;

void ClothSolver::set_state(const Points3& positions, const Points3& velocities, const Points3& slopes,
                            const Points3& surfaces) {
  impl_->load(positions, slopes, impl_->stepper.x);
  impl_->load_surfaces(surfaces, impl_->stepper.x);
  if (impl_->newton.pairs && impl_->crosses(positions, surfaces)) {
    refuse("positions: must not cross a surface, and cloth that feels itself must not cross itself");
  }
  impl_->load(velocities, Points3::Zero(slopes.rows(), 3), impl_->stepper.v);
  impl_->stepper.restart();
  impl_->controller.restart();
}

StepReport ClothSolver::step(double dt, const Points3& gravity, const Points3& held, const Points3& slopes,
                             const Points3& surfaces, const std::vector<Body>& bodies, double damping) {
  return impl_->stepper.step(dt, {gravity, held, slopes, surfaces, bodies, damping});
}

StepReport ClothSolver::advance(double begin, double end, const Motion& motion) {
  return impl_->controller.advance(begin, end, motion);
}

double ClothSolver::last_dt() const { return impl_->stepper.last_dt(); }
Eigen::Vector3d ClothSolver::momentum_rate() const { return impl_->stepper.momentum_rate(); }

Points3 ClothSolver::positions() const { return impl_->unload(impl_->stepper.x); }
Points3 ClothSolver::velocities() const { return impl_->unload(impl_->stepper.v); }
Points3 ClothSolver::reactions() const { return impl_->unload(impl_->newton.residual); }

std::vector<std::int32_t> ClothSolver::contacts() const {
  const Numbering& numbering = impl_->numbering;
  std::vector<std::int32_t> out(numbering.vertices, -1);
  for (int i = 0; i < numbering.free_nodes; ++i) out[numbering.vertex[i]] = impl_->newton.contact.touched[i];
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

Points3 ClothSolver::surface_forces() const {
  Points3 out(impl_->numbering.others, 3);
  for (int i = 0; i < impl_->numbering.others; ++i) {
    out.row(i) = -at_node(impl_->newton.residual, impl_->other(i)).transpose();
  }
  const ContactState& contact = impl_->newton.contact;
  for (int i = 0; i < impl_->numbering.free_nodes; ++i) {
    if (contact.touched[i] < impl_->stepper.bodies()) continue;
    const Foot& foot = contact.surfaces->foot(i);
    for (int k = 0; k < 3; ++k) {
      const int vertex = impl_->numbering.vertex[contact.surfaces->triangles()[foot.triangle][k]];
      out.row(vertex - impl_->numbering.vertices - impl_->numbering.slopes) -=
          foot.weights[k] * at_node(impl_->newton.residual, i).transpose();
    }
  }
  return out;
}

ClothSolver::PairForces ClothSolver::pair_forces() const {
  const Numbering& numbering = impl_->numbering;
  std::vector<const Pair*> some;
  if (impl_->newton.pairs) {
    for (const Pair& pair : impl_->newton.pairs->list()) {
      if (!pair.sight.force.isZero(0.0)) some.push_back(&pair);
    }
  }
  const auto count = static_cast<Eigen::Index>(some.size());
  PairForces out{{count, 4}, {count, 4}, Points3(count, 3), Eigen::VectorXd(count), {}};
  for (Eigen::Index p = 0; p < count; ++p) {
    for (int c = 0; c < 4; ++c) {
      const int vertex = numbering.vertex[some[p]->who.node[c]];
      out.vertices(p, c) = vertex < numbering.vertices ? vertex : vertex - numbering.slopes;
    }
    out.weights.row(p) = some[p]->weights.transpose();
    out.forces.row(p) = some[p]->sight.force.transpose();
    out.distance[p] = some[p]->sight.gap + some[p]->thickness;
    out.sliding.push_back(some[p]->row.mode == contact_slip);
  }
  return out;
}

ClothSolver::Energies ClothSolver::energies(const Points3& positions, const Points3& slopes) {
  Buffer<double> at = impl_->stepper.x;
  impl_->load(positions, slopes, at);
  impl_->newton.evaluate(at, false);
  const Assembly& assembly = impl_->assembly;
  return {assembly.membrane_energy, assembly.bending_energy, impl_->unload(assembly.gradient)};
}

Points3 ClothSolver::stiffness_times(const Points3& positions, const Points3& slopes, const Points3& v) {
  const Numbering& numbering = impl_->numbering;
  Assembly& assembly = impl_->assembly;
  Buffer<double> at = impl_->stepper.x;
  impl_->load(positions, slopes, at);
  assembly.definite = false;
  assembly.exact = true;
  impl_->newton.evaluate(at, true);
  assembly.exact = false;
  assembly.clear_diagonal();
  Buffer<float> in(4 * numbering.free_nodes), out(4 * numbering.free_nodes);
  for (int i = 0; i < numbering.free_nodes; ++i) {
    at_node(in, i) = v.row(numbering.vertex[i]).transpose().cast<float>();
  }
  assembly.kernel.apply(assembly.matrix, in.data(), out.data());
  Points3 result = Points3::Zero(numbering.vertices, 3);
  for (int i = 0; i < numbering.free_nodes; ++i) {
    result.row(numbering.vertex[i]) = at_node(out, i).cast<double>().transpose();
  }
  return result;
}

// Inverse iteration: v <- (K + M/T^2)^-1 M v tends to the softest mode, and 1/growth - 1/T^2 to its eigenvalue.
double ClothSolver::softest(const Points3& positions, const Points3& slopes) {
  constexpr double period = 0.3;  // T, s
  constexpr int iterations = 40;
  Assembly& assembly = impl_->assembly;
  const int free_nodes = impl_->numbering.free_nodes;
  Buffer<double> at = impl_->stepper.x;
  impl_->load(positions, slopes, at);
  assembly.read_table(at);
  assembly.set_diagonal(period, 0.0);
  assembly.definite = false;
  impl_->newton.evaluate(at, true);
  LinearSolve linear(assembly, at, period);
  Buffer<float> v(4L * free_nodes + 64, 0.0f), y(v);
  for (int i = 0; i < free_nodes; ++i) at_node(v, i).setConstant(1.0f + 0.1f * static_cast<float>(i % 7));
  double value = 0.0;
  for (int iteration = 0; iteration < iterations; ++iteration) {
    double size = 0.0, growth = 0.0;
    for (int i = 0; i < free_nodes; ++i) size += assembly.mass[i] * at_node(v, i).cast<double>().squaredNorm();
    const float scale = static_cast<float>(1.0 / std::sqrt(size));
    for (float& component : v) component *= scale;
    Buffer<float> force = v;
    for (int i = 0; i < free_nodes; ++i) at_node(force, i) *= static_cast<float>(assembly.mass[i]);
    linear.solve(force, y);
    for (int i = 0; i < free_nodes; ++i) {
      growth += assembly.mass[i] * at_node(v, i).cast<double>().dot(at_node(y, i).cast<double>());
    }
    value = 1.0 / growth - 1.0 / (period * period);
    v = y;
  }
  return value;
}

double ClothSolver::factor_error(const Points3& positions, const Points3& slopes, double dt) {
  Assembly& assembly = impl_->assembly;
  Newton& newton = impl_->newton;
  const int free_nodes = impl_->numbering.free_nodes;
  Buffer<double> at = impl_->stepper.x;
  impl_->load(positions, slopes, at);
  assembly.set_diagonal(dt, 0.0);
  newton.evaluate(at, true);
  std::fill(newton.contact.mode.begin(), newton.contact.mode.end(), static_cast<int>(contact_open));
  StaleFactor& factor = newton.factors.latest();
  factor.make(assembly, at, newton.contact, dt);
  factor.forget();
  Buffer<float> v(4 * free_nodes), b(4 * free_nodes);
  unsigned state = 1;
  for (int i = 0; i < free_nodes; ++i) {
    for (int c = 0; c < 3; ++c) {
      state = state * 1664525u + 1013904223u;
      v[4 * i + c] = static_cast<float>(state >> 8) / (1 << 23) - 1.0f;
    }
  }
  NeighbourNumbers numbers;
  assembly.kernel.apply(assembly.neighbour(at, numbers), v.data(), b.data());
  assembly.kernel.solve(factor.view(), free_nodes, b.data(), b.data());
  double wrong = 0.0, size = 0.0;
  for (std::size_t i = 0; i < v.size(); ++i) {
    wrong += (v[i] - b[i]) * (v[i] - b[i]);
    size += v[i] * v[i];
  }
  return std::sqrt(wrong / size);
}

std::pair<double, double> ClothSolver::part_error(const std::vector<std::int32_t>& sticking, double dt) {
  const Buffer<double>& x = impl_->stepper.x;
  Assembly& assembly = impl_->assembly;
  assembly.set_diagonal(dt, 0.0);
  impl_->newton.evaluate(x, true);
  ContactState contact(impl_->numbering.free_nodes);
  StaleFactor part(impl_->numbering), whole(impl_->numbering);
  ClothSettings settings{};
  settings.refactor_after = settings.krylov_max = krylov_max;
  part.renew(assembly, x, contact, dt, settings);
  for (const std::int32_t vertex : sticking) contact.mode[impl_->numbering.node[vertex]] = contact_stick;
  const double share = part.renew(assembly, x, contact, dt, settings);
  whole.renew(assembly, x, contact, dt, settings);
  float wrong = 0.0f, size = 0.0f;
  for (std::size_t i = 0; i < whole.storage().tiles.size(); ++i) {
    wrong = std::max(wrong, std::abs(whole.storage().tiles[i] - part.storage().tiles[i]));
    size = std::max(size, std::abs(whole.storage().tiles[i]));
  }
  return {wrong / size, share};
}

const Eigen::VectorXd& ClothSolver::masses() const { return impl_->assembly.mass_of_vertex; }
ClothPhases ClothSolver::phases() const { return impl_->newton.phases; }
double ClothSolver::factor_flops() const {
  const std::vector<double>& work = impl_->newton.factors.latest().storage().work;
  return std::accumulate(work.begin(), work.end(), 0.0);
}
std::size_t ClothSolver::factor_floats() const { return impl_->newton.factors.latest().storage().tiles.size(); }
std::string ClothSolver::kernel() const { return impl_->assembly.kernel.name; }

}  // namespace sim_core
