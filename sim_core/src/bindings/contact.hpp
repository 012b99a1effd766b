// Contact of cloth with cloth as Python sees it, for tests.
#pragma once

#include <nanobind/nanobind.h>

namespace sim_core {

void bind_contact(nanobind::module_& m);

}  // namespace sim_core
