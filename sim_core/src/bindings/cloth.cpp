// The Python face of the cloth solver.
#include <nanobind/eigen/dense.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/function.h>
#include <nanobind/stl/map.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <functional>
#include <map>
#include <tuple>

#include "cloth/constants.hpp"
#include "cloth/mesh.hpp"
#include "cloth/solver.hpp"

namespace sim_core {

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using BodyTuple = std::tuple<int, std::vector<double>, Eigen::Vector3d, double, Eigen::Vector3d,
                             Eigen::Matrix3d, std::vector<double>>;

using FabricTuple = std::tuple<double, StretchTable, Eigen::Matrix3d, double, double>;

using BodyRateTuple = std::tuple<Eigen::Vector3d, Eigen::Vector3d>;
using SensitivityTermTuple = std::tuple<int, int, int, double>;
using DriveRatesTuple = std::tuple<Points3, Points3, std::vector<BodyRateTuple>>;

using ConditionsCallback =
    std::function<std::tuple<Points3, Points3, Points3, std::vector<BodyTuple>, double,
                             std::vector<DriveRatesTuple>>(double time)>;

using TableCallback = std::function<std::pair<Points3, decltype(MotionTable::poses)>(
    const std::vector<double>& times)>;

struct DriveNow {
  Points3 gravity, held, surfaces;
  std::vector<Body> bodies;
  std::vector<DriveRates> rates;
};

std::vector<DriveRates> rates_of(const std::vector<DriveRatesTuple>& tuples) {
  std::vector<DriveRates> rates;
  for (const auto& [held, gravity, bodies] : tuples) {
    DriveRates by{held, gravity, {}};
    for (const auto& [origin, turn] : bodies) by.bodies.push_back({origin, turn});
    rates.push_back(by);
  }
  return rates;
}

std::vector<Body> bodies_of(const std::vector<BodyTuple>& tuples) {
  std::vector<Body> bodies;
  for (const auto& [shape, mu, core, radius, origin, rotation, mu_static] : tuples) {
    bodies.push_back({shape, mu, core, radius, origin, rotation, mu_static});
  }
  return bodies;
}

}  // namespace

void bind_cloth(nb::module_& m) {
  m.def(
      "sheet_count",
      [](const Points2& rest, const Triangles& triangles) {
        return ClothMesh(rest, triangles).sheets;
      },
      "rest"_a, "triangles"_a,
      "Internal: number of pieces of a mesh that hang together. Raises ValueError, naming the "
      "field, unless it is a "
      "triangulation that cloth can have.");
  m.def(
      "body_gaps",
      [](const BodyTuple& body, const Points3& points) {
        const Body at = bodies_of({body})[0];
        Eigen::VectorXd distances(points.rows());
        Points3 normals(points.rows(), 3);
        for (Eigen::Index i = 0; i < points.rows(); ++i) {
          const Gap gap = gap_of(at, points.row(i).transpose());
          distances[i] = gap.distance;
          normals.row(i) = gap.normal.transpose();
        }
        return std::make_pair(distances, normals);
      },
      "body"_a, "points"_a,
      "Internal: signed distances of points (N, 3) from a body (N,) [m], negative inside, and the "
      "outward normals there (N, 3).");
  m.def("self_intersections", &self_intersections, "positions"_a, "triangles"_a,
        "Internal: see stickslip_sim_core.self_intersections.");
  nb::class_<DiagnosticExtremes>(m, "Observed",
                                 "Worst values over the accepted steps, for the checks of a run.")
      .def_ro("stretch", &DiagnosticExtremes::stretch, "Largest principal stretch of a triangle.")
      .def_ro("depth", &DiagnosticExtremes::depth,
              "Largest depth in a body beyond what round bodies allow [cells].")
      .def_ro("passages", &DiagnosticExtremes::passages,
              "Triangles that passed the core of a body.")
      .def_ro("contact_work", &DiagnosticExtremes::contact_work,
              "Work of bodies on motion against them, where positive [J].")
      .def_ro("flow", &DiagnosticExtremes::flow,
              "Sum of the sizes of all changes of energy and of all work [J].")
      .def_ro("gain", &DiagnosticExtremes::gain,
              "Largest energy gained beyond the work of all forces [J].")
      .def_prop_ro(
          "friction",
          [](const DiagnosticExtremes& extremes) {
            std::vector<std::pair<double, double>> out;
            for (const FrictionWork& with : extremes.friction)
              out.emplace_back(with.work, with.error);
            return out;
          },
          "Work of friction with each body, then surface, then sheet, and its estimated error "
          "[J].");
  m.attr("radius_least") = radius_least;
  m.attr("compression") = compression;
  m.attr("step_iterations_max") = control::iterations_max;
  nb::class_<StepReport>(m, "StepReport", "How a step of cloth went, or several.")
      .def(nb::init<>())
      .def("add", &StepReport::add, "later"_a, "Add the report of later steps.")
      .def_ro("converged", &StepReport::converged)
      .def_ro("residual", &StepReport::residual, "Largest residual force of a node [N].")
      .def_ro("steps", &StepReport::steps)
      .def_ro("unconverged", &StepReport::unconverged)
      .def_ro("step_error", &StepReport::step_error,
              "Largest estimate of how far one step alone misplaces a vertex [m].")
      .def_ro("newton", &StepReport::newton)
      .def_ro("krylov", &StepReport::krylov)
      .def_ro("factorizations", &StepReport::factorizations)
      .def_prop_ro(
          "rungs",
          [](const StepReport& report) {
            std::map<std::string, std::pair<int, int>> out;
            for (std::size_t r = 0; r < rung_names.size(); ++r) {
              out[rung_names[r]] = {report.rungs[r].tried, report.rungs[r].converged};
            }
            return out;
          },
          "How often each rung of the fallback ladder was tried and how often it converged, by "
          "name. The solver tries them in the order: attempt, plain, stiff_pairs, smoothed_law, "
          "persistent, best_iterate. A rung that converged solved the step, or a part of it. See "
          "cloth/stepping.hpp.")
      .def_ro("seen", &StepReport::extremes)
      .def_ro("motion_error", &StepReport::motion_error,
              "Distance of what drives the cloth from an even motion within a step of the "
              "controller [m].")
      .def_ro("least_distance", &StepReport::least_distance,
              "Of pieces of cloth that do not hang together, at the ends of steps [m]; infinite "
              "where none are near.");
  nb::class_<SensitivityReport>(m, "SensitivityReport",
                                "How well the equations of the sensitivities were solved.")
      .def_ro("steps", &SensitivityReport::steps)
      .def_ro("rounds", &SensitivityReport::rounds, "Rounds of refinement, over all parameters.")
      .def_ro("krylov", &SensitivityReport::krylov)
      .def_ro("unrefined", &SensitivityReport::unrefined,
              "Steps of a parameter that another round would change too much.")
      .def_ro("change", &SensitivityReport::change,
              "Largest change left to one more round, over the largest derivative.");
  using PairForces = ClothSolver::PairForces;
  nb::class_<PairForces>(m, "PairForces",
                         "Forces of cloth on cloth and surfaces at P pairs of closest points.")
      .def_ro("vertices", &PairForces::vertices,
              "(P, 4); those of surfaces come after those of the cloth.")
      .def_ro("weights", &PairForces::weights,
              "(P, 4): the force acts on each vertex by its weight.")
      .def_ro("forces", &PairForces::forces, "(P, 3) [N]")
      .def_ro("distance", &PairForces::distance, "(P,) [m]")
      .def_ro("sliding", &PairForces::sliding, "(P,)");
  nb::class_<ClothSolver>(m, "ClothSolver",
                          "Internal: see stickslip_sim_core.Cloth and cloth/solver.hpp.")
      .def(
          "__init__",
          [](ClothSolver* self, const Points2& rest, const Triangles& triangles,
             const std::vector<FabricTuple>& fabrics, const std::vector<std::int32_t>& held,
             double tolerance, int newton_max, double krylov_tolerance, int refactor_after,
             int newton_before_halving, int halvings_max, bool second_order, double step_error,
             double longest_step, int finest, const std::string& kernel,
             const std::vector<double>& thickness, const Eigen::MatrixXd& mu, double edge_fraction,
             double second_fraction, const Triangles& surface_triangles,
             const std::vector<std::int32_t>& surface_of_vertex, const Points3& surface_positions,
             const std::vector<double>& crease, const Eigen::MatrixXd& mu_static) {
            std::vector<ClothProperties> list;
            for (const auto& [density, stretching, rigidity, damping, softening] : fabrics) {
              list.push_back({density, stretching, rigidity, damping, softening});
            }
            new (self)
                ClothSolver({rest,
                             triangles,
                             list,
                             held,
                             {tolerance, newton_max, krylov_tolerance, refactor_after,
                              newton_before_halving, halvings_max, second_order},
                             {step_error, longest_step, finest},
                             kernel,
                             {thickness, mu, static_cast<int>(thickness.size() - crease.size()),
                              edge_fraction, second_fraction, mu_static},
                             {surface_triangles, surface_of_vertex, surface_positions, crease}});
          },
          "rest"_a, "triangles"_a, "fabrics"_a, "held"_a, nb::kw_only(), "tolerance"_a,
          "newton_max"_a, "krylov_tolerance"_a, "refactor_after"_a, "newton_before_halving"_a,
          "halvings_max"_a, "second_order"_a, "step_error"_a, "longest_step"_a, "finest"_a,
          "kernel"_a, "thickness"_a, "mu"_a, "edge_fraction"_a, "second_fraction"_a,
          "surface_triangles"_a, "surface_of_vertex"_a, "surface_positions"_a, "crease"_a,
          "mu_static"_a)
      .def(
          "set_state",
          [](ClothSolver& self, const Points3& positions, const Points3& velocities,
             const Points3& surfaces, const std::vector<BodyTuple>& bodies, bool begins) {
            self.set_state(positions, velocities, surfaces, bodies_of(bodies), begins);
          },
          "positions"_a, "velocities"_a, "surfaces"_a, "bodies"_a, "begins"_a)
      .def(
          "step",
          [](ClothSolver& self, double dt, const Points3& gravity, const Points3& held,
             const Points3& surfaces, const std::vector<BodyTuple>& bodies, double damping,
             const std::vector<DriveRatesTuple>& rates) {
            const std::vector<Body> list = bodies_of(bodies);
            const std::vector<DriveRates> by = rates_of(rates);
            nb::gil_scoped_release release;
            return self.step(dt, gravity, held, surfaces, list, damping, by);
          },
          "dt"_a, "gravity"_a, "held"_a, "surfaces"_a, "bodies"_a, "damping"_a, "rates"_a)
      .def(
          "follow",
          [](ClothSolver& self, const std::vector<std::vector<SensitivityTermTuple>>& parameters) {
            std::vector<SensitivityParameter> list;
            for (const auto& terms : parameters) {
              list.emplace_back();
              for (const auto& [kind, first, second, rate] : terms) {
                list.back().push_back(
                    {static_cast<SensitivityTerm::Kind>(kind), first, second, rate});
              }
            }
            self.follow(list);
          },
          "parameters"_a)
      .def("position_sensitivities", &ClothSolver::position_sensitivities)
      .def("velocity_sensitivities", &ClothSolver::velocity_sensitivities)
      .def("set_sensitivities", &ClothSolver::set_sensitivities, "x"_a, "v"_a)
      .def("nearest_events", &ClothSolver::nearest_events)
      .def("sensitivity_report", &ClothSolver::sensitivity_report)
      .def(
          "advance",
          [](ClothSolver& self, double time, double event, const ConditionsCallback& conditions,
             const TableCallback& table, bool may_fail) {
            DriveNow now;
            nb::gil_scoped_release release;
            const auto conditions_at = [&](double at) -> BoundaryConditions {
              nb::gil_scoped_acquire acquire;
              auto [gravity, held, surfaces, bodies, damping, rates] = conditions(at);
              now = {gravity, held, surfaces, bodies_of(bodies), rates_of(rates)};
              return {now.gravity, now.held, now.surfaces, now.bodies, damping, now.rates};
            };
            const auto table_at = [&](const std::vector<double>& times) -> MotionTable {
              nb::gil_scoped_acquire acquire;
              auto [points, poses] = table(times);
              return {points, poses};
            };
            const StepReport report =
                self.advance(time, event, {conditions_at, table_at}, may_fail);
            return std::make_tuple(time, report);
          },
          "time"_a, "event"_a, "conditions"_a, "table"_a, "may_fail"_a)
      .def("momentum_rate", &ClothSolver::momentum_rate)
      .def("damping_force", &ClothSolver::damping_force)
      .def("positions", &ClothSolver::positions)
      .def("velocities", &ClothSolver::velocities)
      .def("reactions", &ClothSolver::reactions)
      .def("contacts", &ClothSolver::contacts)
      .def("sliding", &ClothSolver::sliding)
      .def("opposites", &ClothSolver::opposites)
      .def("opposite_forces", &ClothSolver::opposite_forces)
      .def("surface_forces", &ClothSolver::surface_forces)
      .def("pair_forces", &ClothSolver::pair_forces)
      .def("masses", &ClothSolver::masses)
      .def("energies", &ClothSolver::energies, "positions"_a)
      .def("softest", &ClothSolver::lowest_eigenvalue, "positions"_a)
      .def("kernel", &ClothSolver::kernel);
}

}  // namespace sim_core
