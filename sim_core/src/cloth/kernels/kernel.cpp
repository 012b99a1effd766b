// The arithmetic of cloth: energies, matrix, Cholesky factor, Krylov method. Compiled once per
// instruction set with CLOTH_FLOATS floats in a vector; see math/lanes.hpp on why all names are in
// an unnamed namespace.
//
// Sums are taken in an order that depends on CLOTH_FLOATS alone: equal machines give equal bits.
#include "cloth/kernels/bending.hpp"
#include "cloth/kernels/krylov.hpp"
#include "cloth/kernels/membrane.hpp"
#include "cloth/kernels/recycling.hpp"

namespace sim_core {

constinit const ClothKernel CLOTH_KERNEL = {KERNEL_LEVEL,    membrane,       membrane_lag, bending,
                                            bending_changes, bending_matrix, apply,        factor,
                                            krylov,          recycle};

}  // namespace sim_core
