"""Internal: the C++ core. Use stickslip_sim_core."""

from collections.abc import Callable, Mapping, Sequence
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
    def cloth_kernel(self) -> str:
        """
        Level of the cloth kernels: the widest of this processor, or STICKSLIP_CLOTH_KERNEL. Levels differ in the last digits.
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
    Internal: see stickslip_sim_core.solve_general_rods; arrays as in rods/general_rods.hpp.
    """

def relax_chain(gamma: float, stiffness: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], natural: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], quaternions: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')]) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')], float, bool, bool]:
    """
    Internal: equilibrium of one chain: quaternions (N + 1, 4), energy, converged, stable. See rods/chain.hpp.
    """

def chain_frames(curvature: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], clamp: Annotated[NDArray[numpy.float64], dict(shape=(4), order='C')]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')]:
    """
    Internal: quaternions (N + 1, 4) of the chain with curvature (N, 3) in its elements.
    """

def chain_centerline(quaternions: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]:
    """Internal: positions (N + 1, 3) of the nodes of a chain, L."""

def chain_jacobian(gamma: float, stiffness: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], natural: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], quaternions: Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')], basis: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], stride: int) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
    """
    Internal: derivatives of nodal positions by gamma and natural curvature. See rods/chain.hpp.
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

def check_mesh(rest: Annotated[NDArray[numpy.float64], dict(shape=(None, 2), order='C')], triangles: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C')]) -> None:
    """
    Internal: raises ValueError, naming the field, unless this is a triangulation that cloth can have.
    """

def sheet_count(rest: Annotated[NDArray[numpy.float64], dict(shape=(None, 2), order='C')], triangles: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C')]) -> int:
    """Internal: number of pieces of a mesh that hang together."""

def self_intersections(positions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], triangles: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C')]) -> int:
    """Internal: see stickslip_sim_core.self_intersections."""

def cloth_kernels() -> list[str]:
    """Internal: cloth kernels this processor can run, narrowest first."""

def cloth_constants() -> dict[str, float]:
    """
    Internal: constants of the cloth solver by name; see cloth/constants.hpp.
    """

class Observed:
    """Worst values over the accepted steps, for the checks of a run."""

    def __init__(self) -> None: ...

    def add(self, next: Observed) -> None:
        """Add the values of later steps."""

    @property
    def stretch(self) -> float:
        """Largest principal stretch of a triangle."""

    @property
    def depth(self) -> float:
        """Largest depth in a body beyond what round bodies allow [cells]."""

    @property
    def passages(self) -> int:
        """Triangles that passed the core of a body."""

    @property
    def contact_work(self) -> float:
        """Work of bodies on motion against them, where positive [J]."""

    @property
    def flow(self) -> float:
        """Sum of the sizes of all changes of energy and of all work [J]."""

    @property
    def gain(self) -> float:
        """Largest energy gained beyond the work of all forces [J]."""

class StepReport:
    """How a step of cloth went."""

    @property
    def converged(self) -> bool: ...

    @property
    def residual(self) -> float:
        """Largest residual force of a node [N]."""

    @property
    def steps(self) -> int: ...

    @property
    def unconverged(self) -> int: ...

    @property
    def missed(self) -> int:
        """Steps of the controller that are further off than it allows."""

    @property
    def newton(self) -> int: ...

    @property
    def krylov(self) -> int: ...

    @property
    def factorizations(self) -> float: ...

    @property
    def flips(self) -> int:
        """Changes of contacts between open, stick and slip."""

    @property
    def halvings(self) -> int: ...

    @property
    def seen(self) -> Observed: ...

    @property
    def sharpest(self) -> float:
        """Least radius of a skeleton that cloth touched, in cells."""

    @property
    def uneven(self) -> float:
        """
        Distance of what drives the cloth from an even motion within a step of the controller [m].
        """

    @property
    def least_distance(self) -> float:
        """
        Of pieces of cloth that do not hang together, at the ends of steps [m]; infinite where none are near.
        """

class ClothSolver:
    """Internal: see stickslip_sim_core.Cloth and cloth/solver.hpp."""

    def __init__(self, rest: Annotated[NDArray[numpy.float64], dict(shape=(None, 2), order='C')], triangles: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C')], fabrics: Sequence[tuple[float, Annotated[NDArray[numpy.float64], dict(shape=(6, 4), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(3, 3), order='F')], float]], held: Sequence[int], *, tolerance: float, newton_max: int, krylov_max: int, krylov_tolerance: float, refactor_after: int, patience: int, halvings_max: int, step_error: float, longest_step: float, finest: int, kernel: str, thickness: Sequence[float], mu: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='F')], edge_share: float, second_share: float, surface_triangles: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C')], surface_of_vertex: Sequence[int], surface_positions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], crease: Sequence[float], constants: Mapping[str, float] = {}) -> None: ...

    def set_state(self, positions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], velocities: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], surfaces: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], bodies: Sequence[tuple[int, Sequence[float], Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], float, Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(3, 3), order='F')]]], begins: bool) -> None: ...

    def step(self, dt: float, gravity: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], held: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], surfaces: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], bodies: Sequence[tuple[int, Sequence[float], Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], float, Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(3, 3), order='F')]]], damping: float) -> StepReport: ...

    def advance(self, time: float, event: float, motion: Callable[[float], tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], Sequence[tuple[int, Sequence[float], Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], float, Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(3, 3), order='F')]]], float]], path: Callable[[Sequence[float]], tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')]]]) -> tuple[float, StepReport]: ...

    def momentum_rate(self) -> Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')]: ...

    def positions(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]: ...

    def velocities(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]: ...

    def reactions(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]: ...

    def contacts(self) -> list[int]: ...

    def sliding(self) -> list[int]: ...

    def surface_forces(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]: ...

    def pair_forces(self) -> tuple[Annotated[NDArray[numpy.int32], dict(shape=(None, 4), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, 4), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], list[int], list[int]]: ...

    def masses(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]: ...

    def energies(self, positions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]) -> tuple[float, float, Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]]: ...

    def stiffness_times(self, positions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], v: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]: ...

    def softest(self, positions: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]) -> float: ...

    def phases(self) -> tuple[float, float, float, float]: ...

    def kernel(self) -> str: ...

def closest_weights(edges: bool, x: Annotated[NDArray[numpy.float64], dict(shape=(4, 3), order='C')]) -> Annotated[NDArray[numpy.float64], dict(shape=(4), order='C')]:
    """Internal: see contact/closest.hpp."""

def safe_share(edges: bool, x: Annotated[NDArray[numpy.float64], dict(shape=(4, 3), order='C')], to: Annotated[NDArray[numpy.float64], dict(shape=(4, 3), order='C')], keep: float, most: float, floor: float = 0.0) -> float:
    """Internal: see contact/closest.hpp."""

def contact_candidates(triangles: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C')], x: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], reach: float) -> list[list[int]]:
    """
    Internal: kind (0: vertex and triangle, 1: edges) and vertices of near pairs.
    """

def cap_motion(triangles: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C')], start: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], end: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], thickness: float, margin: float) -> Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]:
    """Internal: see contact/path.hpp."""

def feet(triangles: Annotated[NDArray[numpy.int32], dict(shape=(None, 3), order='C')], x: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], crease: float, points: Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')]) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, 3), order='C')], list[int]]:
    """
    Internal: height, normal, foot and triangle (-1: an edge) of points over a smooth surface; see contact/pn_triangles.hpp.
    """

def pair_law(gap: float, normal: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], slip: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], force: Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], mu: float, stiffness: float, along: float, across: float, smoothing: float = 0.0) -> tuple[int, Annotated[NDArray[numpy.float64], dict(shape=(3, 3), order='F')], Annotated[NDArray[numpy.float64], dict(shape=(3, 3), order='F')], Annotated[NDArray[numpy.float64], dict(shape=(3), order='C')], float]:
    """
    Internal: mode, stiffness, its symmetric part, force and squared error; see contact/pair_law.hpp.
    """
