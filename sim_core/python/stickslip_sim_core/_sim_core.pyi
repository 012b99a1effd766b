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

def solve_general_rods(gamma: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], stiffness: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C', device='cpu', writable=False)], clamp: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C', device='cpu', writable=False)], natural: Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], start: Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], slope: Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], natural_at_points: Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3), order='C', device='cpu', writable=False)], elements: int, curvature_max: float, start_level: int = -1, kernel: str = '') -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None, 3, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]]:
    """
    Internal: see stickslip_sim_core.solve_general_rods; arrays as in general_rods.hpp.
    """

def relax_chain(gamma: float, stiffness: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], natural: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], quaternions: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')]) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')], float, bool, bool]:
    """
    Internal: equilibrium of one chain: quaternions (N + 1, 4), energy, converged, stable. See rod_chain.hpp.
    """

def chain_frames(curvature: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], clamp: Annotated[NDArray[numpy.float64], dict(shape=(4), order='C')]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')]:
    """
    Internal: quaternions (N + 1, 4) of the chain with curvature (N, 3) in its elements.
    """

def chain_centerline(quaternions: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]:
    """Internal: positions (N + 1, 3) of the nodes of a chain, L."""

def chain_jacobian(gamma: float, stiffness: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], natural: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], quaternions: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')], basis: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], stride: int) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
    """
    Internal: derivatives of nodal positions by gamma and natural curvature. See rod_chain.hpp.
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
