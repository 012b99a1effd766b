// The Python face: arrays in, arrays out. Checks that name fields for the user are in rods/.
#include <nanobind/eigen/dense.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <memory>
#include <string>
#include <tuple>

#include "build_constants.hpp"
#include "kernel_levels.hpp"
#include "math/refusal.hpp"
#include "rods/chain.hpp"
#include "rods/rods.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace sim_core {

void bind_cloth(nb::module_& m);

namespace {

using Input = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <int columns>
using InputRows = nb::ndarray<const double, nb::shape<-1, columns>, nb::c_contig, nb::device::cpu>;
using InputVectors = nb::ndarray<const double, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
template <class Scalar, class... Shape>
using Output = nb::ndarray<nb::numpy, Scalar, nb::c_contig, Shape...>;

// A fresh, uninitialised array that NumPy owns.
template <class Array>
Array allocate(std::initializer_list<std::size_t> shape) {
  using Scalar = typename Array::Scalar;
  std::size_t size = 1;
  for (std::size_t extent : shape) size *= extent;
  auto data = std::make_unique_for_overwrite<Scalar[]>(size);
  nb::capsule owner(data.get(), [](void* p) noexcept { delete[] static_cast<Scalar*>(p); });
  return Array(data.release(), shape, owner);
}

using Vectors = Output<double, nb::shape<-1, -1, 3>>;
using Frames = Output<double, nb::shape<-1, -1, 3, 3>>;
using Numbers = Output<double, nb::shape<-1>>;
using Counts = Output<std::int32_t, nb::shape<-1>>;
using Truths = Output<bool, nb::shape<-1>>;
using Solution =
    std::tuple<Vectors, Vectors, Frames, Numbers, Truths, Truths, Counts, Numbers, Numbers>;

// Rods between two looks at pending signals: a few milliseconds of work.
constexpr std::int64_t rods_between_signals = 256;

// The arrays of a solution, and where a kernel writes.
struct RodArrays {
  std::size_t n, points;
  Vectors centerline = allocate<Vectors>({n, points, 3}),
          curvature = allocate<Vectors>({n, points, 3});
  Frames frame = allocate<Frames>({n, points, 3, 3});
  Numbers energy = allocate<Numbers>({n}), residual = allocate<Numbers>({n}),
          refinement = allocate<Numbers>({n});
  Truths converged = allocate<Truths>({n}), stable = allocate<Truths>({n});
  Counts iterations = allocate<Counts>({n});

  RodOutput output() {
    return {centerline.data(), curvature.data(),  frame.data(),     energy.data(), residual.data(),
            refinement.data(), iterations.data(), converged.data(), stable.data()};
  }

  Solution solution() const {
    return {centerline, curvature,  frame,    energy,    stable,
            converged,  iterations, residual, refinement};
  }
};

template <class Batch, class Kernel>
void solve_in_parts(Kernel solve, const Batch& batch, const RodSettings& settings, int points,
                    std::size_t n) {
  const auto samples = sample_points(points, settings.elements);
  const auto total = static_cast<std::int64_t>(n);
  for (std::int64_t begin = 0; begin < total; begin += rods_between_signals) {
    {
      nb::gil_scoped_release unlocked;
      solve(batch, settings, samples, begin, std::min(begin + rods_between_signals, total));
    }
    if (PyErr_CheckSignals() != 0) throw nb::python_error();
  }
}

Solution solve_rods(Input gamma, Input phi0, Input phi1, double twist_stiffness, int elements,
                    int points, int start_level, const std::string& kernel) {
  const std::size_t n = gamma.size(), p = static_cast<std::size_t>(points);
  if (phi0.size() != n || phi1.size() != n) refuse("gamma, phi0, phi1: lengths must be equal");
  const RodSettings settings{twist_stiffness, elements,
                             start_level < 0 ? default_start_level(elements) : start_level};
  double curvature_max = 0.0;
  for (std::size_t i = 0; i < n; ++i)
    curvature_max = std::max(curvature_max, std::hypot(phi0.data()[i], phi1.data()[i]));
  check_settings(settings, points, curvature_max);
  const RodKernels kernels = kernel_level(kernel).rods;
  RodArrays arrays{n, p};
  const RodBatch batch{gamma.data(), phi0.data(), phi1.data(), arrays.output()};
  solve_in_parts(kernels.solve, batch, settings, points, n);
  return arrays.solution();
}

Solution solve_general_rods(Input gamma, InputRows<3> stiffness, InputRows<4> clamp,
                            InputVectors natural, InputVectors start, InputVectors slope,
                            InputVectors natural_at_points, int elements, double curvature_max,
                            const std::string& kernel) {
  const std::size_t n = gamma.size(), p = natural_at_points.shape(1),
                    N = static_cast<std::size_t>(elements);
  const int points = static_cast<int>(p);
  const RodSettings settings{0.0, elements, default_start_level(elements)};
  check_settings(settings, points, curvature_max);
  if (stiffness.shape(0) != n || clamp.shape(0) != n || natural.shape(0) != n ||
      start.shape(0) != n || slope.shape(0) != n || natural_at_points.shape(0) != n ||
      natural.shape(1) != 2 * N + 1 || start.shape(1) != 2 * N + 1 || slope.shape(1) != N / 2 + 1) {
    refuse("solve_general_rods: shapes disagree");
  }
  const RodKernels kernels = kernel_level(kernel).rods;
  RodArrays arrays{n, p};
  const GeneralRodBatch batch{
      gamma.data(), stiffness.data(),         clamp.data(),   natural.data(), start.data(),
      slope.data(), natural_at_points.data(), arrays.output()};
  solve_in_parts(kernels.solve_general, batch, settings, points, n);
  return arrays.solution();
}

struct BuildInfo {
  std::string version, build_hash, compiler, isa, rod_kernel, cloth_kernel, eigen;
};

BuildInfo build_info() {
  const char* pinned = std::getenv("STICKSLIP_CLOTH_KERNEL");
  const std::string isa = SIM_CORE_BUILD_ISA;
  return {SIM_CORE_VERSION,        SIM_CORE_BUILD_HASH,
          SIM_CORE_BUILD_COMPILER, isa.empty() ? SIM_CORE_BUILD_PROCESSOR : isa,
          kernel_names().back(),   kernel_level(pinned ? pinned : "").cloth.name,
          SIM_CORE_BUILD_EIGEN};
}

}  // namespace

NB_MODULE(_sim_core, m) {
#ifdef SIM_CORE_IMPORT_GUARD
  // Best effort: this unit itself was compiled for that instruction set.
  __builtin_cpu_init();
  if (!__builtin_cpu_supports(SIM_CORE_IMPORT_GUARD)) {
    throw nb::import_error("stickslip_sim_core was built for " SIM_CORE_IMPORT_GUARD
                           ", which this processor lacks");
  }
#endif
  m.doc() = "Internal: the C++ core. Use stickslip_sim_core.";
  nb::class_<BuildInfo>(m, "BuildInfo", "What the C++ core was built from.")
      .def_ro("version", &BuildInfo::version)
      .def_ro("build_hash", &BuildInfo::build_hash,
              "SHA-256, hex: over sources, compiler, flags and instruction set.")
      .def_ro("compiler", &BuildInfo::compiler, "Id and version.")
      .def_ro("isa", &BuildInfo::isa, "Instruction set of the whole library.")
      .def_ro("rod_kernel", &BuildInfo::rod_kernel,
              "Vectors of the rod solver on this processor; its bits are the same for all.")
      .def_ro("cloth_kernel", &BuildInfo::cloth_kernel,
              "Level of the cloth kernels: the widest of this processor, or "
              "STICKSLIP_CLOTH_KERNEL. Levels differ in "
              "the last digits.")
      .def_ro("eigen", &BuildInfo::eigen, "Version.");
  m.def("build_info", &build_info, "Tell what the C++ core was built from.");
  m.def("solve_rods", &solve_rods, "gamma"_a, "phi0"_a, "phi1"_a, "twist_stiffness"_a, "elements"_a,
        "points"_a, "start_level"_a = -1, "kernel"_a = "",
        "Internal: see stickslip_sim_core.solve_rods. Level -1 and kernel '' leave the choice to "
        "the solver.");
  m.def("solve_general_rods", &solve_general_rods, "gamma"_a, "stiffness"_a, "clamp"_a, "natural"_a,
        "start"_a, "slope"_a, "natural_at_points"_a, "elements"_a, "curvature_max"_a,
        "kernel"_a = "",
        "Internal: see stickslip_sim_core.solve_general_rods; arrays as in rods/rods.hpp.");
  m.def("relax_chain", &relax_chain, nb::call_guard<nb::gil_scoped_release>(), "gamma"_a,
        "stiffness"_a, "natural"_a, "quaternions"_a,
        "Internal: equilibrium of one chain: quaternions (N + 1, 4), and whether it is stable. See "
        "rods/chain.hpp.");
  m.def("chain_frames", &chain_frames, "curvature"_a, "clamp"_a,
        "Internal: quaternions (N + 1, 4) of the chain with curvature (N, 3) in its elements.");
  m.def("chain_centerline", &chain_centerline, "quaternions"_a,
        "Internal: positions (N + 1, 3) of the nodes of a chain, L.");
  m.def("chain_jacobian", &chain_jacobian, nb::call_guard<nb::gil_scoped_release>(), "gamma"_a,
        "stiffness"_a, "natural"_a, "quaternions"_a, "basis"_a, "stride"_a,
        "Internal: derivatives of nodal positions by gamma and natural curvature. See "
        "rods/chain.hpp.");
  m.def("kernels", &kernel_names,
        "Internal: levels of kernels that this processor runs, narrowest first.");
  m.def("relax_rod", &relax_rod, "gamma"_a, "phi0"_a, "phi1"_a, "twist_stiffness"_a,
        "quaternions"_a, "Internal: as relax_chain, of a uniform round rod.");
  bind_cloth(m);
}

}  // namespace sim_core
