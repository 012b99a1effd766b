// What tests ask of the core that nobody else does: geometry and law of contact, and the
// derivatives of a rod's energy.
#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <limits>
#include <optional>
#include <tuple>

#include "cloth/assembly.hpp"
#include "contact/closest.hpp"
#include "contact/contact_set.hpp"
#include "contact/linearized_contact.hpp"
#include "contact/path.hpp"
#include "contact/pn_triangles.hpp"
#include "kernel_levels.hpp"
#include "rods/chain.hpp"
#include "rods/energy.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace sim_core {
namespace {

using Four = Eigen::Matrix<double, 4, 3, Eigen::RowMajor>;

FourPoints four(const Four& x) { return {x.row(0), x.row(1), x.row(2), x.row(3)}; }

PairKind kind_of(bool edges) { return edges ? PairKind::edge_edge : PairKind::vertex_triangle; }

std::vector<std::array<int, 3>> triples_of(const Triangles& triangles) {
  std::vector<std::array<int, 3>> out;
  for (Eigen::Index t = 0; t < triangles.rows(); ++t) {
    out.push_back({triangles(t, 0), triangles(t, 1), triangles(t, 2)});
  }
  return out;
}

Surface surface_of(const Triangles& triangles, const Points3& x) {
  return {triples_of(triangles), std::vector<int>(x.rows(), 0),
          CollisionMask::Constant(1, 1, true)};
}

Buffer<double> buffer_of(const Points3& x) {
  Buffer<double> out(4 * x.rows(), 0.0);
  for (int i = 0; i < x.rows(); ++i) at_node(out, i) = x.row(i).transpose();
  return out;
}

using T = Lanes<1>;

std::tuple<double, Eigen::VectorXd, Eigen::MatrixXd> rod_derivatives(double gamma, double phi0,
                                                                     double phi1,
                                                                     double twist_stiffness,
                                                                     const Rows4& quaternions) {
  const int n = static_cast<int>(quaternions.rows()) - 1;
  const double h = 1.0 / n;
  const Rod<T> rod{gamma, phi0, phi1, twist_stiffness};
  const auto frame = [&](int i) -> Quat<T> {
    return {quaternions(i, 0), {quaternions(i, 1), quaternions(i, 2), quaternions(i, 3)}};
  };
  // The clamp's rows and columns are kept until the end, to assemble without exceptions.
  Eigen::VectorXd gradient = Eigen::VectorXd::Zero(3 * (n + 1));
  Eigen::MatrixXd hessian = Eigen::MatrixXd::Zero(3 * (n + 1), 3 * (n + 1));
  double energy = 0.0;
  for (int i = 0; i < n; ++i) {
    const Quat<T> a = frame(i), b = frame(i + 1);
    const Element<T> e = element(rod, element_moment(rod, a, b, T(h), T(double(n))), T(double(n)));
    const Eigen::Vector3d f = dense(e.force);
    const Eigen::Matrix3d S = dense(e.stiffness), O = -S + 0.5 * cross_matrix(f);
    energy += e.energy.v[0];
    gradient.segment<3>(3 * i) -= f;
    gradient.segment<3>(3 * i + 3) += f;
    hessian.block<3, 3>(3 * i, 3 * i) += S;
    hessian.block<3, 3>(3 * i + 3, 3 * i + 3) += S;
    hessian.block<3, 3>(3 * i, 3 * i + 3) += O;
    hessian.block<3, 3>(3 * i + 3, 3 * i) += O.transpose();

    const double weight = gamma * (1.0 - i * h) * h;
    const Vec3<T> t = direction1(a);
    energy += (i == 0 ? 0.5 : 1.0) * weight * t.z.v[0];
    gradient.segment<3>(3 * i) += dense(weight_torque(T(weight), t));
    hessian.block<3, 3>(3 * i, 3 * i) += dense(weight_stiffness(T(weight), t));
  }
  return {energy, gradient.tail(3 * n), hessian.bottomRightCorner(3 * n, 3 * n)};
}

}  // namespace
}  // namespace sim_core

NB_MODULE(_testing, m) {
  using namespace sim_core;
  m.doc() = "For tests of stickslip_sim_core, in editable installs only.";
  m.def("rod_derivatives", &rod_derivatives, "gamma"_a, "phi0"_a, "phi1"_a, "twist_stiffness"_a,
        "quaternions"_a,
        "Energy [EI/L], gradient (3N) and Hessian (3N, 3N) of a chain of N + 1 unit quaternions "
        "(w, x, y, z), by world "
        "rotations of nodes 1 ... N.");
  m.def(
      "closest_weights",
      [](bool edges, const Four& x) { return closest_weights(kind_of(edges), four(x)); }, "edges"_a,
      "x"_a, "See contact/closest.hpp.");
  m.def(
      "safe_fraction",
      [](bool edges, const Four& x, const Four& to, double keep, double most, double floor) {
        return safe_fraction(kind_of(edges), four(x), four(to), {keep, most, floor});
      },
      "edges"_a, "x"_a, "to"_a, "keep"_a, "most"_a, "floor"_a = 0.0, "See contact/closest.hpp.");
  m.def(
      "stiffness_times",
      [](const Points2& rest, const Triangles& triangles, double density,
         const StretchTable& stretching, const Eigen::Matrix3d& rigidity, const Points3& x,
         const Points3& v, double softening) {
        const ClothMesh mesh(rest, triangles);
        const MatrixApproximation exact{0.0, 0.0};  // no fold is too small, and none is old
        Assembly assembly(kernel_level("").cloth, mesh,
                          Fabrics(mesh, {{density, stretching, rigidity, 0.0, softening}}), {}, 0,
                          exact);
        const std::vector<int>& node = assembly.numbering.node;
        Buffer<double> at(4 * x.rows());
        Buffer<float> in(4 * x.rows()), out(4 * x.rows());
        for (int i = 0; i < x.rows(); ++i) {
          at_node(at, node[i]) = x.row(i).transpose();
          at_node(in, node[i]) = v.row(i).transpose().cast<float>();
        }
        assembly.evaluate(at, true);
        assembly.kernel.apply(assembly.matrix, in.data(), out.data());
        Points3 result(x.rows(), 3);
        for (int i = 0; i < x.rows(); ++i)
          result.row(i) = at_node(out, node[i]).cast<double>().transpose();
        return result;
      },
      "rest"_a, "triangles"_a, "density"_a, "stretching"_a, "rigidity"_a, "x"_a, "v"_a,
      "softening"_a = 0.0, "K v with the matrix of Newton's method at x, without mass.");
  m.def(
      "contact_candidates",
      [](const Triangles& triangles, const Points3& x, double reach) {
        std::vector<std::array<int, 5>> out;
        for (const Candidate& pair : candidates(surface_of(triangles, x), buffer_of(x), reach)) {
          out.push_back({static_cast<int>(pair.kind), pair.node[0], pair.node[1], pair.node[2],
                         pair.node[3]});
        }
        return out;
      },
      "triangles"_a, "x"_a, "reach"_a,
      "kind (0: vertex and triangle, 1: edges) and vertices of near pairs.");
  m.def(
      "cap_motion",
      [](const Triangles& triangles, const Points3& from, const Points3& to, double thickness,
         double skin) {
        Buffer<double> end = buffer_of(to);
        CandidateSet near(surface_of(triangles, from), thickness, skin);
        near.limit_by_ccd(buffer_of(from), end);
        Points3 out(to.rows(), 3);
        for (int i = 0; i < to.rows(); ++i) out.row(i) = at_node(end, i).transpose();
        return out;
      },
      "triangles"_a, "start"_a, "end"_a, "thickness"_a, "skin"_a, "See contact/path.hpp.");
  m.def(
      "feet",
      [](const Triangles& triangles, const Points3& x, double crease, const Points3& points) {
        const Buffer<double> at = buffer_of(x);
        const PNTriangles patches(triples_of(triangles), at,
                                  std::vector<double>(triangles.rows(), crease));
        const TriangleTree tree(patches.triangles(), at);
        const PatchShape shape = patches.shape(at);
        Eigen::VectorXd height =
            Eigen::VectorXd::Constant(points.rows(), std::numeric_limits<double>::quiet_NaN());
        Points3 normal(points.rows(), 3), point(points.rows(), 3);
        std::vector<std::int32_t> triangle(points.rows(), -1);
        for (Eigen::Index i = 0; i < points.rows(); ++i) {
          const Eigen::Vector3d p = points.row(i).transpose();
          const Nearest near = tree.nearest(p, 1e300, [](int) { return true; });
          const double side = patches.side_of(shape, p, near.triangle, near.weights);
          const std::optional<Projection> projection =
              patches.projection(shape, p, near.triangle, side);
          if (!projection) continue;
          height[i] = side * projection->height;
          normal.row(i) = side * projection->normal.transpose();
          point.row(i) = projection->point.transpose();
          triangle[i] = projection->on_patch ? projection->triangle : -1;
        }
        return std::make_tuple(height, normal, point, triangle);
      },
      "triangles"_a, "x"_a, "crease"_a, "points"_a,
      "height, normal, projection and triangle (-1: an edge) of points over a smooth surface; see "
      "contact/pn_triangles.hpp.");
  m.def(
      "coulomb_law",
      [](double gap, const Eigen::Vector3d& normal, const Eigen::Vector3d& slip,
         const Eigen::Vector3d& force, double mu, double stiffness, double smoothing) {
        const Contact contact{gap, normal, slip, force, mu, stiffness};
        const LawResponse law =
            smoothing > 0.0 ? smoothed_law(contact, smoothing) : coulomb_law(contact);
        const LawDerivative& d = law.derivative;
        return std::make_tuple(
            static_cast<int>(law.mode), Eigen::Vector3d(law.normal_force * normal + law.friction),
            law.direction, Eigen::Vector4d(d.normal, d.along, d.across, d.coupling));
      },
      "gap"_a, "normal"_a, "slip"_a, "force"_a, "mu"_a, "stiffness"_a, "smoothing"_a = 0.0,
      "mode, the force that the law asks, the direction of friction and the four derivatives; see "
      "contact/coulomb_law.hpp.");
  m.def(
      "pair_row",
      [](double gap, const Eigen::Vector3d& normal, const Eigen::Vector3d& slip,
         const Eigen::Vector3d& force, double mu, double stiffness, double along, double across,
         double smoothing) {
        const Contact contact{gap, normal, slip, force, mu, stiffness};
        const LawResponse law =
            smoothing > 0.0 ? smoothed_law(contact, smoothing) : coulomb_law(contact);
        const PairRow row = pair_row(contact, law, {along, across});
        return std::make_tuple(static_cast<int>(row.mode), row.stiffness, row.symmetric, row.force,
                               missed_squared(contact, smoothing), row.force_by_normal);
      },
      "gap"_a, "normal"_a, "slip"_a, "force"_a, "mu"_a, "stiffness"_a, "along"_a, "across"_a,
      "smoothing"_a = 0.0,
      "mode, stiffness, its symmetric part, force, squared error and force by normal; see "
      "contact/linearized_contact.hpp.");
  m.def(
      "closing",
      [](double gap, const Eigen::Vector3d& normal, const Eigen::Vector3d& slip,
         const Eigen::Vector3d& force, double mu, double stiffness, const Eigen::Vector3d& motion) {
        const LawResponse law = closing({gap, normal, slip, force, mu, stiffness}, motion);
        return std::make_tuple(static_cast<int>(law.mode), law.direction);
      },
      "gap"_a, "normal"_a, "slip"_a, "force"_a, "mu"_a, "stiffness"_a, "motion"_a,
      "mode and direction of friction of an open contact that a motion closes; see "
      "contact/coulomb_law.hpp.");
  m.def(
      "pair_changes",
      [](const Four& weights, const Eigen::Vector3d& force, const Eigen::Vector3d& row_force,
         const Eigen::Matrix3d& row_stiffness, const Eigen::Matrix<double, 2, 9>& sliding,
         const Eigen::Matrix<double, 3, 9>& force_by_motions, const Four& displacements) {
        Pair pair{};
        pair.stencil.node = {0, 1, 2, 3};
        pair.weights = weights.col(0);
        pair.along_first = weights.col(1);
        pair.along_second = weights.col(2);
        pair.contact.force = force;
        pair.row.force = row_force;
        pair.row.stiffness = row_stiffness;
        pair.sliding = sliding;
        pair.force_by_motions = force_by_motions;
        Buffer<float> change(16);
        for (int c = 0; c < 4; ++c)
          at_node(change, c) = displacements.row(c).transpose().cast<float>();
        return std::make_tuple(pair.motions(change, 4), pair.force_change(change, 4),
                               pair.stiffness());
      },
      "weights"_a, "force"_a, "row_force"_a, "row_stiffness"_a, "sliding"_a, "force_by_motions"_a,
      "displacements"_a,
      "motions, change of the force and stiffness of a pair; see contact/contact_set.hpp.");
  m.def(
      "node_row",
      [](double gap, const Eigen::Vector3d& normal, const Eigen::Vector3d& slip,
         const Eigen::Vector3d& force, double mu, double stiffness, double turning_max) {
        const Contact contact{gap, normal, slip, force, mu, stiffness};
        const NodeRow row = node_row(contact, coulomb_law(contact), turning_max);
        return std::make_tuple(static_cast<int>(row.mode), row.direction, row.force, row.correction,
                               row.coupling, row.turn_stiffness);
      },
      "gap"_a, "normal"_a, "slip"_a, "force"_a, "mu"_a, "stiffness"_a, "turning_max"_a,
      "mode, direction, force, correction, coupling and turn stiffness; see "
      "contact/linearized_contact.hpp.");
}
