// The Python face of the cloth solver, in a unit of its own.
#pragma once

#include <nanobind/nanobind.h>

namespace sim_core {

void bind_cloth(nanobind::module_& m);

}  // namespace sim_core
