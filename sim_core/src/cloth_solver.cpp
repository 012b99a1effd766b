#include "cloth_solver.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <ctime>
#include <limits>
#include <set>
#include <sstream>
#include <stdexcept>

#include "cloth_kernels.hpp"
#include "cloth_order.hpp"

namespace sim_core {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3d;

// Contact stiffnesses over a node's own: of the complementarity function [Alart & Curnier 1991] and in the factor.
constexpr double contact_share = 0.1;
constexpr float factor_share = 100.0f;
// Slip below this share of the friction force is as good as stuck for the factor.
constexpr double turning_max = 1e3;
// A matrix of bending is assembled again when its stiffening has changed by more.
constexpr float stiffening_change = 0.03f;
// Iterations after which a step is halved rather than pursued, and up to which steps may grow again.
constexpr int patience = 20, easy = 12;
// GMRES may stop earlier by this factor while nodes still change between open, stick and slip.
constexpr double coarse = 6.0;

double cpu_seconds() {
  timespec now{};
  clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

struct Stopwatch {
  double& total;
  double start = cpu_seconds();
  explicit Stopwatch(double& total_in) : total(total_in) {}
  ~Stopwatch() { total += cpu_seconds() - start; }
};

struct Gap {
  double distance;
  Vector3d normal;
};

Gap gap_of(const Body& body, const Vector3d& x) {
  const Vector3d local = body.rotation.transpose() * (x - body.origin);
  if (body.shape == Body::plane) return {local.z(), body.rotation.col(2)};
  if (body.shape == Body::sphere) {
    const double r = local.norm();
    return {r - body.size[0], r > 0.0 ? Vector3d(body.rotation * (local / r)) : Vector3d(body.rotation.col(2))};
  }
  const Vector3d beyond = local.cwiseAbs() - body.size, outside = beyond.cwiseMax(0.0);
  const double r = outside.norm();
  Vector3d normal = Vector3d::Zero();
  if (r > 0.0) {
    for (int c = 0; c < 3; ++c) normal[c] = std::copysign(outside[c] / r, local[c]);
    return {r, body.rotation * normal};
  }
  int axis = 0;
  beyond.maxCoeff(&axis);
  normal[axis] = std::copysign(1.0, local[axis]);
  return {beyond[axis], body.rotation * normal};
}

Body between(const Body& a, const Body& b, double share) {
  Body out = b;
  out.origin = a.origin + share * (b.origin - a.origin);
  if (a.rotation != b.rotation) {
    const Eigen::Quaterniond p(a.rotation), q(b.rotation);
    out.rotation = p.slerp(share, q).toRotationMatrix();
  }
  return out;
}

}  // namespace

ClothKernel best_cloth_kernel() {
  if (const char* asked = std::getenv("STICKSLIP_CLOTH_KERNEL")) {
    const std::string name = asked;
    if (name == "baseline") return cloth_kernel_baseline();
    if (name == "x86-64-v3") return cloth_kernel_x86_64_v3();
  }
#ifdef SIM_CORE_X86_64_KERNELS
  __builtin_cpu_init();
  if (__builtin_cpu_supports("x86-64-v4")) return cloth_kernel_x86_64_v4();
  if (__builtin_cpu_supports("x86-64-v3")) return cloth_kernel_x86_64_v3();
#endif
  return cloth_kernel_baseline();
}

bool StretchTable::constant() const {
  for (int r = 1; r < 6; ++r) {
    if (k.row(r) != k.row(0)) return false;
  }
  return true;
}

struct ClothSolver::Impl {
  ClothKernel kernel = best_cloth_kernel();
  ClothSettings settings;
  StretchTable stretching;
  bool constant_stretching;
  ClothPhases phases;

  int vertices, free_nodes, nodes;  // nodes: vertices, then slopes at clamped edges
  int slopes;
  std::vector<int> node_of, vertex_of;  // vertex or slope <-> node
  std::vector<int> held;                // nodes of the held vertices, in the caller's order
  Eigen::VectorXd mass_of_vertex;
  Buffer<double> mass;  // (nodes)

  Buffer<int> membrane_nodes, membrane_slots;
  Buffer<double> membrane_shape, membrane_area, membrane_stiffness;
  MembraneData membrane{};
  struct Bending {
    std::vector<int> begin, nodes, slot_begin, slots;
    Buffer<double> weights;
    std::vector<double> area, spacing2;
    BendingData view{};
  };
  Bending bending, near_bending;  // the second is compact: of the factor
  double rigidity_size;

  std::vector<int> near_begin, near_node, scalar_begin, scalar_node, block_begin, block_node, scalar_diagonal,
      block_diagonal;
  Buffer<float> scalars, near_scalars, blocks, definite_blocks, diagonal, added;
  Buffer<float> stiffening, assembled_stiffening;
  ClothMatrix matrix{};
  std::unique_ptr<FactorStorage> factor_storage;
  Factor factor{};
  bool factored = false;
  bool definite = false;  // whether the matrix has the positive part of the stress only
  double factored_dt = 0.0;
  int last_krylov = 0, fresh = -1, excess = 0;  // iterations of the last solve, the first with this factor, beyond that

  // State and work, (nodes, 4).
  Buffer<double> x, v, start, gradient, residual, inertial, trial, best, unused;
  Buffer<float> rhs, correction, change, work, image;
  // Contact.
  std::vector<Body> bodies, bodies_before;
  std::vector<int> mode, modes, touched;
  std::vector<double> stiffness;
  Buffer<float> normal, direction, mu, turning;
  ContactRows contact{};
  bool started = false;
  int depth_hint = 0, hardest = 0;  // halvings that steps need of late, and Newton iterations of the worst part

  Impl(const Points2& rest, const Triangles& triangles, const ClothProperties& properties,
       const std::vector<std::int32_t>& held_in, const Edges& clamped, const ClothSettings& settings_in)
      : settings(settings_in),
        stretching(properties.stretching),
        constant_stretching(properties.stretching.constant()),
        slopes(static_cast<int>(clamped.rows())) {
    const ClothMesh mesh(rest, triangles);
    vertices = static_cast<int>(rest.rows());
    nodes = vertices + slopes;
    const std::vector<Stencil> stencils = bending_stencils(mesh, properties.rigidity, clamped);
    const std::vector<Stencil> near = bending_stencils(mesh, properties.rigidity, clamped, true);
    number(mesh, stencils, near, held_in);
    mass_of_vertex = Eigen::VectorXd::Zero(vertices);
    for (Eigen::Index t = 0; t < triangles.rows(); ++t) {
      for (int c = 0; c < 3; ++c) mass_of_vertex[triangles(t, c)] += properties.density * mesh.area[t] / 3.0;
    }
    mass.assign(nodes, 0.0);
    for (int i = 0; i < vertices; ++i) mass[node_of[i]] = mass_of_vertex[i];
    build_membrane(mesh);
    build_bending(mesh, stencils, properties.rigidity, scalar_begin, scalar_node, bending);
    build_bending(mesh, near, properties.rigidity, near_begin, near_node, near_bending);
    stiffening.assign(2 * triangles.rows(), 0.0f);
    assembled_stiffening.assign(2 * triangles.rows(), -1.0f);
    rigidity_size = properties.rigidity.cwiseAbs().maxCoeff();
    for (Buffer<double>* buffer : {&x, &v, &start, &gradient, &residual, &inertial, &trial, &best, &unused})
      buffer->assign(4 * nodes, 0.0);
    for (Buffer<float>* buffer : {&rhs, &correction, &change, &image, &normal, &direction}) {
      buffer->assign(4 * free_nodes + 64, 0.0f);
    }
    work.assign((2 * krylov_max + 1) * 4L * free_nodes + 64, 0.0f);
    mu.assign(free_nodes, 0.0f);
    turning.assign(free_nodes, 0.0f);
    mode.assign(free_nodes, contact_open);
    touched.assign(free_nodes, -1);
    stiffness.assign(free_nodes, 0.0);
    added.assign(6 * free_nodes, 0.0f);
    contact = {mode.data(), normal.data(), direction.data(), mu.data(), turning.data()};
  }

  // Nodes: free vertices in the order of elimination, held vertices, slopes.
  void number(const ClothMesh& mesh, const std::vector<Stencil>& stencils, const std::vector<Stencil>& near_stencils,
              const std::vector<std::int32_t>& held_in) {
    std::vector<char> is_held(vertices, 0);
    for (std::int32_t h : held_in) {
      if (h < 0 || h >= vertices) {
        throw std::invalid_argument("held: must index " + std::to_string(vertices) + " vertices, got " +
                                    std::to_string(h));
      }
      if (is_held[h]) throw std::invalid_argument("held: must not repeat a vertex, and repeats " + std::to_string(h));
      is_held[h] = 1;
    }
    std::vector<int> local(vertices, -1), free_vertices;
    for (int i = 0; i < vertices; ++i) {
      if (!is_held[i]) {
        local[i] = static_cast<int>(free_vertices.size());
        free_vertices.push_back(i);
      }
    }
    free_nodes = static_cast<int>(free_vertices.size());
    if (free_nodes == 0) throw std::invalid_argument("held: must leave a vertex free");
    const auto coupled = [&](const std::vector<Stencil>& by) {
      std::vector<std::set<int>> sets(free_nodes);
      for (const Stencil& stencil : by) {
        for (int a : stencil.nodes) {
          if (a >= vertices || local[a] < 0) continue;
          for (int b : stencil.nodes) {
            if (b < vertices && local[b] >= 0) sets[local[a]].insert(local[b]);
          }
        }
      }
      Graph graph(free_nodes);
      for (int i = 0; i < free_nodes; ++i) graph[i].assign(sets[i].begin(), sets[i].end());
      return graph;
    };
    const Graph graph = coupled(stencils), near_graph = coupled(near_stencils);
    Points2 points(free_nodes, 2);
    for (int i = 0; i < free_nodes; ++i) points.row(i) = mesh.rest.row(free_vertices[i]);
    const Dissection dissection = nested_dissection(near_graph, points);
    node_of.assign(nodes, -1);
    vertex_of.assign(nodes, -1);
    std::vector<int> place(free_nodes);
    for (int i = 0; i < free_nodes; ++i) {
      place[dissection.order[i]] = i;
      node_of[free_vertices[dissection.order[i]]] = i;
    }
    int next = free_nodes;
    for (std::int32_t h : held_in) {
      node_of[h] = next;
      held.push_back(next++);
    }
    for (int i = vertices; i < nodes; ++i) node_of[i] = next++;
    for (int i = 0; i < nodes; ++i) vertex_of[node_of[i]] = i;

    const auto renumbered = [&](const Graph& from) {
      Graph ordered(free_nodes);
      for (int i = 0; i < free_nodes; ++i) {
        for (int j : from[dissection.order[i]]) ordered[i].push_back(place[j]);
        std::sort(ordered[i].begin(), ordered[i].end());
      }
      return ordered;
    };
    const auto compress = [&](const Graph& ordered, std::vector<int>& begin, std::vector<int>& node) {
      begin.assign(1, 0);
      for (int i = 0; i < free_nodes; ++i) {
        node.insert(node.end(), ordered[i].begin(), ordered[i].end());
        begin.push_back(static_cast<int>(node.size()));
      }
    };
    const Graph ordered = renumbered(near_graph);
    compress(renumbered(graph), scalar_begin, scalar_node);
    compress(ordered, near_begin, near_node);
    std::vector<std::set<int>> near(free_nodes);
    for (Eigen::Index t = 0; t < mesh.triangles.rows(); ++t) {
      for (int a = 0; a < 3; ++a) {
        for (int b = 0; b < 3; ++b) {
          const int i = node_of[mesh.triangles(t, a)], j = node_of[mesh.triangles(t, b)];
          if (i < free_nodes && j < free_nodes) near[i].insert(j);
        }
      }
    }
    block_begin.assign(1, 0);
    for (int i = 0; i < free_nodes; ++i) {
      block_node.insert(block_node.end(), near[i].begin(), near[i].end());
      block_begin.push_back(static_cast<int>(block_node.size()));
    }
    for (int i = 0; i < free_nodes; ++i) {
      scalar_diagonal.push_back(slot(scalar_begin, scalar_node, i, i));
      block_diagonal.push_back(slot(block_begin, block_node, i, i));
    }
    scalars.assign(scalar_node.size(), 0.0f);
    near_scalars.assign(near_node.size(), 0.0f);
    blocks.assign(12 * block_node.size(), 0.0f);
    definite_blocks = blocks;
    diagonal.assign(free_nodes, 0.0f);
    matrix = {free_nodes,         scalar_begin.data(), scalar_node.data(), scalars.data(),
              block_begin.data(), block_node.data(),   blocks.data(),      diagonal.data()};
    factor_storage =
        std::make_unique<FactorStorage>(ordered, dissection, near_begin, near_node, block_begin, block_node);
    factor = factor_storage->view();
  }

  int slot(const std::vector<int>& begin, const std::vector<int>& node, int i, int j) const {
    if (i >= free_nodes || j >= free_nodes) return -1;
    const auto first = node.begin() + begin[i], last = node.begin() + begin[i + 1];
    const auto at = std::lower_bound(first, last, j);
    return at != last && *at == j ? static_cast<int>(at - node.begin()) : -1;
  }

  void build_membrane(const ClothMesh& mesh) {
    constexpr int W = membrane_lanes;
    const int count = static_cast<int>(mesh.triangles.rows()), groups = (count + W - 1) / W;
    membrane_nodes.assign(3 * W * groups, 0);
    membrane_slots.assign(9 * W * groups, -1);
    membrane_shape.assign(4 * W * groups, 0.0);
    membrane_area.assign(W * groups, 0.0);
    membrane_stiffness.assign(4 * W * groups, 0.0);
    for (int t = 0; t < count; ++t) {
      const int group = t / W, lane = t % W;
      int n[3];
      for (int c = 0; c < 3; ++c) {
        n[c] = node_of[mesh.triangles(t, c)];
        membrane_nodes[(3 * group + c) * W + lane] = n[c];
      }
      const Eigen::Vector2d p = mesh.rest.row(mesh.triangles(t, 0));
      Eigen::Matrix2d edges;
      edges.col(0) = mesh.rest.row(mesh.triangles(t, 1)).transpose() - p;
      edges.col(1) = mesh.rest.row(mesh.triangles(t, 2)).transpose() - p;
      const Eigen::Matrix2d inverse = edges.inverse();  // rows: gradients of the shape functions
      for (int c = 0; c < 4; ++c) membrane_shape[(4 * group + c) * W + lane] = inverse(c / 2, c % 2);
      membrane_area[group * W + lane] = mesh.area[t];
      for (int c = 0; c < 4; ++c) membrane_stiffness[(4 * group + c) * W + lane] = stretching.k(0, c);
      int* slots = &membrane_slots[9 * (group * W + lane)];
      const int pairs[9][2] = {{0, 1}, {1, 0}, {0, 2}, {2, 0}, {1, 2}, {2, 1}, {0, 0}, {1, 1}, {2, 2}};
      for (int k = 0; k < 9; ++k) slots[k] = slot(block_begin, block_node, n[pairs[k][0]], n[pairs[k][1]]);
    }
    // Lanes that pad the last group read its first triangle and weigh nothing.
    for (int t = count; t < groups * W; ++t) {
      const int group = t / W, lane = t % W;
      for (int c = 0; c < 3; ++c) membrane_nodes[(3 * group + c) * W + lane] = membrane_nodes[3 * group * W + c * W];
    }
    membrane = {groups,
                membrane_nodes.data(),
                membrane_shape.data(),
                membrane_area.data(),
                membrane_stiffness.data(),
                membrane_slots.data()};
  }

  void build_bending(const ClothMesh& mesh, const std::vector<Stencil>& stencils, const Rigidity& d,
                     const std::vector<int>& begin, const std::vector<int>& node, Bending& out) {
    out.begin.assign(1, 0);
    const int count = static_cast<int>(stencils.size());
    for (int t = 0; t < count; ++t) {
      const Stencil& stencil = stencils[t];
      for (std::size_t i = 0; i < stencil.nodes.size(); ++i) {
        out.nodes.push_back(node_of[stencil.nodes[i]]);
        for (int c = 0; c < 3; ++c) out.weights.push_back(stencil.weights(i, c));
        out.weights.push_back(0.0);
      }
      out.slot_begin.push_back(static_cast<int>(out.slots.size() / 2));
      for (std::size_t i = 0; i < stencil.nodes.size(); ++i) {
        for (std::size_t j = 0; j <= i; ++j) {
          const int a = node_of[stencil.nodes[i]], b = node_of[stencil.nodes[j]];
          out.slots.push_back(slot(begin, node, a, b));
          out.slots.push_back(slot(begin, node, b, a));
        }
      }
      out.begin.push_back(static_cast<int>(out.nodes.size()));
      out.area.push_back(mesh.area[t]);
      out.spacing2.push_back(2.0 * mesh.area[t]);
    }
    out.view = {count,
                out.begin.data(),
                out.nodes.data(),
                out.weights.data(),
                out.area.data(),
                out.spacing2.data(),
                {d(0, 0), d(0, 1), d(0, 2), d(1, 1), d(1, 2), d(2, 2)},
                out.slot_begin.data(),
                out.slots.data()};
  }

  // Stiffnesses of the table at the strain at hand; they stay for the whole step.
  void update_stretching(const Buffer<double>& at) {
    if (constant_stretching) return;
    constexpr int W = membrane_lanes;
    for (int group = 0; group < membrane.groups; ++group) {
      for (int lane = 0; lane < W; ++lane) {
        if (membrane_area[group * W + lane] == 0.0) continue;
        const double* p[3];
        for (int c = 0; c < 3; ++c) p[c] = &at[4L * membrane_nodes[(3 * group + c) * W + lane]];
        const double* s = &membrane_shape[4L * W * group];
        double f[2][3];
        for (int c = 0; c < 3; ++c) {
          const double a = p[1][c] - p[0][c], b = p[2][c] - p[0][c];
          f[0][c] = a * s[lane] + b * s[2 * W + lane];
          f[1][c] = a * s[W + lane] + b * s[3 * W + lane];
        }
        double g00 = -0.5, g11 = -0.5, g01 = 0.0;
        for (int c = 0; c < 3; ++c) {
          g00 += 0.5 * f[0][c] * f[0][c];
          g11 += 0.5 * f[1][c] * f[1][c];
          g01 += 0.5 * f[0][c] * f[1][c];
        }
        const double mean = 0.5 * (g00 + g11), half = 0.5 * (g00 - g11), radius = std::hypot(half, g01);
        const double stretch = std::sqrt(std::max(0.0, 1.0 + 2.0 * (mean + radius))) - 1.0;
        const double share = std::clamp(stretch / table_stretch, 0.0, 1.0);
        if (!std::isfinite(radius)) continue;
        const double angle = 0.5 * std::abs(std::atan2(g01, half));  // of the larger principal stretch, 0 ... pi/2
        const double place = std::min(angle / (M_PI / 8.0), 4.0);
        const int row = std::min(static_cast<int>(place), 3);
        const double between = place - row;
        for (int c = 0; c < 4; ++c) {
          const double far = (1.0 - between) * stretching.k(1 + row, c) + between * stretching.k(2 + row, c);
          membrane_stiffness[(4 * group + c) * W + lane] = (1.0 - share) * stretching.k(0, c) + share * far;
        }
      }
    }
  }

  double membrane_energy = 0.0, bending_energy = 0.0;

  void evaluate(const Buffer<double>& at, bool with_matrix) {
    const Stopwatch watch(phases.assembly);
    std::fill(gradient.begin(), gradient.end(), 0.0);
    if (with_matrix) std::fill(blocks.begin(), blocks.end(), 0.0f);
    membrane_energy =
        kernel.membrane(membrane, at.data(), gradient.data(), with_matrix ? blocks.data() : nullptr, definite);
    bending_energy = kernel.bending(bending.view, at.data(), gradient.data(), stiffening.data());
    if (with_matrix) {
      float change_max = 0.0f;
      for (std::size_t t = 0; t < stiffening.size(); t += 2) {
        const float scale = static_cast<float>(1.0 / rigidity_size);
        change_max = std::max({change_max, std::abs(stiffening[t] - assembled_stiffening[t]),
                               scale * std::abs(stiffening[t + 1] - assembled_stiffening[t + 1])});
      }
      if (change_max > stiffening_change) {
        std::fill(scalars.begin(), scalars.end(), 0.0f);
        kernel.bending_matrix(bending.view, stiffening.data(), scalars.data());
        assembled_stiffening = stiffening;
      }
    }
  }

  void set_diagonal(double dt, double damping) {
    for (int i = 0; i < free_nodes; ++i) diagonal[i] = static_cast<float>(mass[i] * (1.0 / (dt * dt) + damping / dt));
  }

  double own_stiffness(int i) const {
    const float* block = &blocks[12L * block_diagonal[i]];
    return diagonal[i] + scalars[scalar_diagonal[i]] + (block[0] + block[5] + block[10]) / 3.0;
  }

  void factorize(const Buffer<double>& now) {
    const Stopwatch watch(phases.factorization);
    for (int i = 0; i < free_nodes; ++i) {
      float* own = &added[6L * i];
      std::fill(own, own + 6, 0.0f);
      if (mode[i] == contact_open) continue;
      const float k = factor_share * static_cast<float>(own_stiffness(i));
      const float* n = &normal[4L * i];
      const float* t = &direction[4L * i];
      const float side = mode[i] == contact_stick ? k : std::min(turning[i], k);
      const float along = mode[i] == contact_stick ? k : 0.0f;
      // k n n^T + along t t^T + side (1 - n n^T - t t^T)
      int e = 0;
      for (int r = 0; r < 3; ++r) {
        for (int c = r; c < 3; ++c) {
          own[e++] = (k - side) * n[r] * n[c] + (along - side) * t[r] * t[c] + (r == c ? side : 0.0f);
        }
      }
    }
    std::fill(definite_blocks.begin(), definite_blocks.end(), 0.0f);
    kernel.membrane(membrane, now.data(), unused.data(), definite_blocks.data(), true);
    ClothMatrix approximate = matrix;
    approximate.membrane = definite_blocks.data();
    std::fill(near_scalars.begin(), near_scalars.end(), 0.0f);
    kernel.bending_matrix(near_bending.view, stiffening.data(), near_scalars.data());
    approximate.bending = near_scalars.data();
    kernel.factor(factor, approximate, {added.data()});
    factored = true;
  }

  Eigen::Map<Vector3d> at(Buffer<double>& buffer, int node) { return Eigen::Map<Vector3d>(&buffer[4L * node]); }
  Eigen::Map<const Vector3d> at(const Buffer<double>& buffer, int node) const {
    return Eigen::Map<const Vector3d>(&buffer[4L * node]);
  }

  Eigen::Map<Eigen::Vector3f> row(Buffer<float>& buffer, int node) {
    return Eigen::Map<Eigen::Vector3f>(&buffer[4L * node]);
  }

  struct Norms {
    double largest = 0.0, squared = 0.0;
  };

  // R = M a + grad E - M g: the force that a node needs from contact. Sorts nodes into open, stick and slip by the
  // complementarity function of [Alart & Curnier 1991] and sets the right-hand side and the rows of Newton's system.
  Norms contact_state(const Buffer<double>& now, double dt, double damping, const std::vector<Body>& at_end,
                      const std::vector<Body>& at_start) {
    const Stopwatch watch(phases.contact);
    Norms norms;
    const double inertia = 1.0 / (dt * dt), viscous = damping / dt;
    for (int i = 0; i < nodes; ++i) {
      at(residual, i) = mass[i] * (inertia * (at(now, i) - at(inertial, i)) + viscous * (at(now, i) - at(start, i))) +
                        at(gradient, i);
    }
    for (int i = 0; i < free_nodes; ++i) {
      const Vector3d r = at(residual, i), p = at(now, i);
      Gap gap{std::numeric_limits<double>::infinity(), Vector3d::UnitZ()};
      int which = -1;
      for (std::size_t b = 0; b < at_end.size(); ++b) {
        const Gap one = gap_of(at_end[b], p);
        if (one.distance < gap.distance) gap = one, which = static_cast<int>(b);
      }
      const double k = stiffness[i];
      const double pressing = r.dot(gap.normal);
      auto force = row(rhs, i), held_back = row(correction, i);
      held_back.setZero();
      if (which < 0 || !(pressing - k * gap.distance > 0.0)) {
        mode[i] = contact_open;
        touched[i] = -1;
        force = -r.cast<float>();
        count(norms, r.squaredNorm());
        continue;
      }
      touched[i] = which;
      const Vector3d n = gap.normal;
      const Body &end = at_end[which], &begin = at_start[which];
      const Vector3d before = at(start, i);
      const Vector3d carried = end.origin + end.rotation * (begin.rotation.transpose() * (before - begin.origin));
      Vector3d u = p - carried;
      u -= u.dot(n) * n;
      const Vector3d tangential = r - pressing * n;
      const double bound = end.mu * std::max(pressing, 0.0);
      const Vector3d tau = tangential - k * u;
      const double size = tau.norm();
      row(normal, i) = n.cast<float>();
      const double open = k * gap.distance;
      if (size <= bound && bound > 0.0) {
        mode[i] = contact_stick;
        force.setZero();
        held_back = (-gap.distance * n - u).cast<float>();
        mu[i] = turning[i] = 0.0f;
        row(direction, i).setZero();
        count(norms, open * open + k * k * u.squaredNorm());
      } else {
        mode[i] = contact_slip;
        const Vector3d t = size > 0.0 ? Vector3d(tau / size) : Vector3d(n.unitOrthogonal());
        const double along = t.dot(tangential) - bound;
        const Vector3d across = tangential - t.dot(tangential) * t;
        const double scale = size - bound > size / turning_max ? size / (size - bound) : turning_max;
        force = (-along * t - scale * across).cast<float>();
        // J adds turning (1 - t t^T) v to the tangential rows.
        row(direction, i) = t.cast<float>();
        turning[i] = static_cast<float>(size > 0.0 ? scale * bound / size * k : 0.0);
        mu[i] = pressing > 0.0 ? static_cast<float>(end.mu) : 0.0f;
        held_back = (-gap.distance * n).cast<float>();
        count(norms, open * open + (tangential - bound * t).squaredNorm());
      }
    }
    return norms;
  }

  static void count(Norms& norms, double squared) {
    norms.squared += squared;
    if (!(squared <= norms.largest * norms.largest)) norms.largest = std::sqrt(squared);  // a NaN stays
  }

  // What contact prescribes, `correction`, goes to the right-hand side.
  void subtract_corrections() {
    if (std::all_of(correction.begin(), correction.end(), [](float c) { return c == 0.0f; })) return;
    kernel.apply(matrix, correction.data(), image.data());
    for (int i = 0; i < free_nodes; ++i) {
      if (mode[i] == contact_stick) continue;
      auto force = row(rhs, i), pulled = row(image, i);
      if (mode[i] == contact_open) {
        force -= pulled;
        continue;
      }
      const auto n = row(normal, i), t = row(direction, i);
      const float pressing = n.dot(pulled);
      force -= pulled - pressing * n - mu[i] * pressing * t;
    }
  }

  // One implicit Euler step from (start, v) to x, or the best found. `from_rest`: begin at `start`, not where v leads.
  bool attempt(double dt, double damping, const std::vector<Body>& at_end, const std::vector<Body>& at_start,
               bool from_rest, int iterations, StepReport& report, double& residual_out) {
    for (int i = 0; i < free_nodes; ++i) {
      Vector3d p = at(start, i);
      if (!from_rest) p += dt * at(v, i);
      for (const Body& body : at_end) {
        const Gap gap = gap_of(body, p);
        if (gap.distance < 0.0) p -= gap.distance * gap.normal;
      }
      at(x, i) = p;
    }
    set_diagonal(dt, damping);
    if (factored_dt != dt) factored = false;
    evaluate(x, true);
    for (int i = 0; i < free_nodes; ++i) stiffness[i] = contact_share * own_stiffness(i);
    Norms norms = contact_state(x, dt, damping, at_end, at_start);
    bool changed = true;
    modes = mode;
    double window[4];
    std::fill(window, window + 4, norms.squared);
    best = x;
    double least = norms.squared;
    for (int iteration = 0; iteration < iterations; ++iteration) {
      if (norms.largest <= settings.tolerance) break;
      if (!std::isfinite(norms.squared)) break;
      ++report.newton;
      if (!factored || excess > settings.refactor_after || last_krylov >= settings.krylov_max) {
        factorize(x);
        ++report.factorizations;
        factored_dt = dt;
        excess = fresh = -1;
      }
      {
        const Stopwatch watch(phases.krylov);
        subtract_corrections();
        double size = 0.0;
        for (float f : rhs) size += static_cast<double>(f) * f;
        size = std::sqrt(size);
        const double tolerance = std::max((changed ? coarse : 1.0) * settings.krylov_tolerance,
                                          0.3 * settings.tolerance / std::max(size, 1e-300));
        const KrylovResult solved = kernel.krylov(matrix, factor, contact, rhs.data(), change.data(), work.data(),
                                                  settings.krylov_max, std::min(tolerance, 0.5));
        last_krylov = solved.iterations;
        if (fresh < 0) fresh = last_krylov, excess = 0;
        excess += std::max(0, last_krylov - fresh);
        report.krylov += solved.iterations;
      }
      for (int i = 0; i < 4 * free_nodes; ++i) change[i] += correction[i];
      // Along the line, non-monotone [Grippo et al. 1986].
      const double limit = *std::max_element(window, window + 4);
      double share = 1.0;
      Norms next;
      for (int cut = 0;; ++cut) {
        trial = x;
        for (int i = 0; i < 4 * free_nodes; ++i) trial[i] += share * change[i];
        evaluate(trial, true);
        next = contact_state(trial, dt, damping, at_end, at_start);
        if (next.squared <= limit * (cut < 4 ? 1.0 : 1e4) || cut == 5) break;
        share *= 0.5;
      }
      changed = mode != modes;
      modes = mode;
      std::swap(x, trial);
      norms = next;
      window[iteration % 4] = norms.squared;
      if (norms.squared < least) least = norms.squared, best = x;
    }
    if (!(norms.largest <= settings.tolerance)) {
      x = best;
      evaluate(x, true);
      norms = contact_state(x, dt, damping, at_end, at_start);
    }
    residual_out = norms.largest;
    return norms.largest <= settings.tolerance;
  }

  void advance(double begin, double end, int depth, double dt, double damping, const Points3& gravity,
               const Points3& held_end, const Points3& slopes_end, const std::vector<Body>& now, StepReport& report) {
    const double part = (end - begin) * dt;
    std::vector<Body> at_start, at_end;
    for (std::size_t b = 0; b < now.size(); ++b) {
      at_start.push_back(between(bodies_before[b], now[b], begin));
      at_end.push_back(between(bodies_before[b], now[b], end));
    }
    start = x;
    for (int i = 0; i < vertices; ++i) {
      const int node = node_of[i];
      at(inertial, node) = at(start, node) + part * at(v, node) + part * part * gravity.row(i).transpose();
    }
    const Buffer<double> from = x, speed = v;
    const double share = (end - begin) / (1.0 - begin);
    for (std::size_t h = 0; h < held.size(); ++h) {
      at(x, held[h]) += share * (held_end.row(h).transpose() - at(x, held[h]));
    }
    for (int s = 0; s < slopes; ++s) {
      const int node = node_of[vertices + s];
      at(x, node) += share * (slopes_end.row(s).transpose() - at(x, node));
    }
    trial = x;
    update_stretching(start);
    double reached = 0.0;
    const bool deepest = depth == settings.halvings_max;
    const int iterations = report.newton;
    bool converged = false;
    if (depth >= depth_hint) {
      definite = depth > 0;  // where steps are hard, the matrix of a convex energy leads on more surely
      converged =
          attempt(part, damping, at_end, at_start, false, deepest ? settings.newton_max : patience, report, reached);
      if (!converged && deepest) {
        converged = attempt(part, damping, at_end, at_start, true, settings.newton_max, report, reached);
      }
    }
    if (!converged && !deepest) {
      if (depth >= depth_hint) depth_hint = depth + 1;
      x = from;
      v = speed;
      const double middle = 0.5 * (begin + end);
      advance(begin, middle, depth + 1, dt, damping, gravity, held_end, slopes_end, now, report);
      advance(middle, end, depth + 1, dt, damping, gravity, held_end, slopes_end, now, report);
      return;
    }
    hardest = std::max(hardest, report.newton - iterations);
    ++report.substeps;
    report.converged = report.converged && converged;
    if (!(reached <= report.residual)) report.residual = reached;  // a NaN stays
    for (int i = 0; i < nodes; ++i) at(v, i) = (at(x, i) - at(start, i)) / part;
  }

  StepReport step(double dt, const Points3& gravity, const Points3& held_end, const Points3& slopes_end,
                  const std::vector<Body>& now, double damping) {
    if (!(dt > 0.0) || !std::isfinite(dt)) throw std::invalid_argument("dt: must be finite and > 0");
    if (gravity.rows() != vertices) throw std::invalid_argument("gravity: must have a row for each vertex");
    if (held_end.rows() != static_cast<Eigen::Index>(held.size())) {
      throw std::invalid_argument("held: must have a row for each held vertex");
    }
    if (slopes_end.rows() != slopes) throw std::invalid_argument("slopes: must have a row for each clamped edge");
    if (!held_end.allFinite() || !slopes_end.allFinite() || !gravity.allFinite()) {
      throw std::invalid_argument("held, slopes and gravity: must be finite");
    }
    if (!started) bodies_before = now;
    started = true;
    if (bodies_before.size() != now.size()) throw std::invalid_argument("bodies: must keep their number");
    StepReport report;
    hardest = 0;
    advance(0.0, 1.0, 0, dt, damping, gravity, held_end, slopes_end, now, report);
    bodies_before = now;
    if (hardest <= easy && depth_hint > 0) --depth_hint;
    for (int i = 0; i < free_nodes; ++i) {
      report.contacts += mode[i] != contact_open;
      report.sliding += mode[i] == contact_slip;
    }
    return report;
  }

  void load(const Points3& positions, const Points3& slope_values, Buffer<double>& into) {
    if (positions.rows() != vertices) throw std::invalid_argument("positions: must have a row for each vertex");
    if (slope_values.rows() != slopes) throw std::invalid_argument("slopes: must have a row for each clamped edge");
    if (!positions.allFinite() || !slope_values.allFinite()) throw std::invalid_argument("positions: must be finite");
    for (int i = 0; i < vertices; ++i) at(into, node_of[i]) = positions.row(i).transpose();
    for (int i = 0; i < slopes; ++i) at(into, node_of[vertices + i]) = slope_values.row(i).transpose();
  }

  Points3 unload(const Buffer<double>& from) const {
    Points3 out(vertices, 3);
    for (int i = 0; i < vertices; ++i) out.row(i) = at(from, node_of[i]).transpose();
    return out;
  }
};

ClothSolver::ClothSolver(const Points2& rest, const Triangles& triangles, const ClothProperties& properties,
                         const std::vector<std::int32_t>& held, const Edges& clamped, const ClothSettings& settings)
    : impl_(std::make_unique<Impl>(rest, triangles, properties, held, clamped, settings)) {}
ClothSolver::~ClothSolver() = default;

void ClothSolver::set_state(const Points3& positions, const Points3& velocities, const Points3& slopes) {
  impl_->load(positions, slopes, impl_->x);
  impl_->load(velocities, Points3::Zero(slopes.rows(), 3), impl_->v);
  impl_->started = false;
}

StepReport ClothSolver::step(double dt, const Points3& gravity, const Points3& held, const Points3& slopes,
                             const std::vector<Body>& bodies, double damping) {
  return impl_->step(dt, gravity, held, slopes, bodies, damping);
}

Points3 ClothSolver::positions() const { return impl_->unload(impl_->x); }
Points3 ClothSolver::velocities() const { return impl_->unload(impl_->v); }
Points3 ClothSolver::reactions() const { return impl_->unload(impl_->residual); }

std::vector<std::int32_t> ClothSolver::contacts() const {
  std::vector<std::int32_t> out(impl_->vertices, -1);
  for (int i = 0; i < impl_->free_nodes; ++i) out[impl_->vertex_of[i]] = impl_->touched[i];
  return out;
}

std::vector<std::int32_t> ClothSolver::sliding() const {
  std::vector<std::int32_t> out(impl_->vertices, 0);
  for (int i = 0; i < impl_->free_nodes; ++i) out[impl_->vertex_of[i]] = impl_->mode[i] == contact_slip;
  return out;
}

ClothSolver::Energies ClothSolver::energies(const Points3& positions, const Points3& slopes) {
  Buffer<double> at = impl_->x;
  impl_->load(positions, slopes, at);
  impl_->evaluate(at, false);
  return {impl_->membrane_energy, impl_->bending_energy, impl_->unload(impl_->gradient)};
}

Points3 ClothSolver::stiffness_times(const Points3& positions, const Points3& slopes, const Points3& v) {
  Buffer<double> at = impl_->x;
  impl_->load(positions, slopes, at);
  impl_->definite = false;
  impl_->evaluate(at, true);
  std::fill(impl_->diagonal.begin(), impl_->diagonal.end(), 0.0f);
  Buffer<float> in(4 * impl_->free_nodes), out(4 * impl_->free_nodes);
  for (int i = 0; i < impl_->free_nodes; ++i) {
    for (int c = 0; c < 3; ++c) in[4 * i + c] = static_cast<float>(v(impl_->vertex_of[i], c));
  }
  impl_->kernel.apply(impl_->matrix, in.data(), out.data());
  Points3 result = Points3::Zero(impl_->vertices, 3);
  for (int i = 0; i < impl_->free_nodes; ++i) {
    for (int c = 0; c < 3; ++c) result(impl_->vertex_of[i], c) = out[4 * i + c];
  }
  return result;
}

double ClothSolver::factor_error(const Points3& positions, const Points3& slopes, double dt) {
  Impl& s = *impl_;
  Buffer<double> at = s.x;
  s.load(positions, slopes, at);
  s.set_diagonal(dt, 0.0);
  s.evaluate(at, true);
  std::fill(s.mode.begin(), s.mode.end(), static_cast<int>(contact_open));
  s.factorize(at);
  s.factored = false;
  Buffer<float> v(4 * s.free_nodes), b(4 * s.free_nodes);
  unsigned state = 1;
  for (int i = 0; i < s.free_nodes; ++i) {
    for (int c = 0; c < 3; ++c) {
      state = state * 1664525u + 1013904223u;
      v[4 * i + c] = static_cast<float>(state >> 8) / (1 << 23) - 1.0f;
    }
  }
  ClothMatrix approximate = s.matrix;
  approximate.bending_begin = s.near_begin.data();
  approximate.bending_node = s.near_node.data();
  approximate.bending = s.near_scalars.data();
  approximate.membrane = s.definite_blocks.data();
  s.kernel.apply(approximate, v.data(), b.data());
  s.kernel.solve(s.factor, s.free_nodes, b.data(), b.data());
  double wrong = 0.0, size = 0.0;
  for (std::size_t i = 0; i < v.size(); ++i) {
    wrong += (v[i] - b[i]) * (v[i] - b[i]);
    size += v[i] * v[i];
  }
  return std::sqrt(wrong / size);
}

const Eigen::VectorXd& ClothSolver::masses() const { return impl_->mass_of_vertex; }
ClothPhases ClothSolver::phases() const { return impl_->phases; }
double ClothSolver::factor_flops() const { return impl_->factor_storage->flops; }
std::size_t ClothSolver::factor_floats() const { return impl_->factor_storage->panels.size(); }
std::string ClothSolver::kernel() const { return impl_->kernel.name; }

}  // namespace sim_core
