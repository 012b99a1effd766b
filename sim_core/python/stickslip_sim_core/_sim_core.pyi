"""Internal: the C++ core. Use stickslip_sim_core."""

from typing import Annotated

import numpy
from numpy.typing import NDArray


class BuildInfo:
    """What the C++ core was built from."""

    @property
    def version(self) -> str: ...

    @property
    def build_hash(self) -> str:
        """SHA-256, hex: over sources, compiler, flags and instruction set."""

    @property
    def compiler(self) -> str:
        """Id and version."""

    @property
    def isa(self) -> str:
        """Instruction set of the whole library."""

    @property
    def rod_kernel(self) -> str:
        """
        Vectors of the rod solver on this processor; its bits are the same for all.
        """

    @property
    def eigen(self) -> str:
        """Version."""

def build_info() -> BuildInfo:
    """Tell what the C++ core was built from."""

def solve_rods(gamma: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], phi0: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], phi1: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], twist_stiffness: float, elements: int, points: int, start_level: int = -1, kernel: str = '') -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]]:
    """
    Internal: see stickslip_sim_core.solve_rods. Level -1 and kernel '' leave the choice to the solver.
    """

def rod_kernels() -> list[str]:
    """Internal: rod kernels this processor can run, narrowest first."""

def rod_derivatives(gamma: float, phi0: float, phi1: float, twist_stiffness: float, quaternions: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), writable=False)]) -> tuple[float, Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='F')]]:
    """
    Internal: energy, gradient (3N) and Hessian (3N, 3N) of a chain of N + 1 unit quaternions (w, x, y, z), by world rotations of nodes 1 ... N.
    """

def relax_rod(gamma: float, phi0: float, phi1: float, twist_stiffness: float, quaternions: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), writable=False)]) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')], float, bool, bool, int, float]:
    """
    Internal: relax a chain of N + 1 unit quaternions (w, x, y, z) with the rod solver's Newton method on this one level; the first, the clamp, stays. Returns quaternions, energy, stable, converged, iterations, residual.
    """
