"""Cloth that moves in contact with bodies, itself and surfaces: the thin face of the C++ solver."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core._sim_core import ClothSolver, StepReport, check_mesh, sheet_count
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.meshes import Mesh
from stickslip_sim_core.cloth.presets import SolverSettings

KERNEL_VARIABLE = "STICKSLIP_CLOTH_KERNEL"
"""Environment variable that names the level of the kernels."""

MU_MAX = 10.0
"""Largest coefficient of friction."""

RESIDUAL_PATCH = 0.005**2
"""Area whose weight residuals are measured in, whatever the mesh [m^2]."""

GRAVITY = 9.81
"""[m/s^2]"""

THICKNESS = 5e-4
"""Of cloth that feels itself or a surface, unless another is given [m]."""

CREASE = float(np.radians(40.0))
"""Angle from which edges of a surface stay sharp, unless another is given [rad]."""

BodyTuple = tuple[int, float, Floats, Floats, Floats]


@dataclass(frozen=True)
class Body:
    """A body that cloth touches. In its own axes a plane fills z < 0; others are centred on their origin, and z is the
    axis of a cylinder."""

    mu: float
    shape: int = 0
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    origin: Floats = field(default_factory=lambda: np.zeros(3))
    rotation: Floats = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        if not 0.0 <= self.mu <= MU_MAX:
            raise ValueError(f"mu: must be in [0, {MU_MAX:g}], got {self.mu}")

    def as_tuple(self) -> BodyTuple:
        """Return what the C++ core takes."""
        return (
            self.shape,
            self.mu,
            np.array(self.size),
            np.asarray(self.origin, float),
            np.asarray(self.rotation, float),
        )


def plane(mu: float, *, normal: ArrayLike = (0.0, 0.0, 1.0), origin: ArrayLike = (0.0, 0.0, 0.0)) -> Body:
    """Return the half-space below a plane."""
    n = np.asarray(normal, float)
    n = n / np.linalg.norm(n)
    other = np.eye(3)[np.argmin(np.abs(n))]
    t = np.cross(n, other)
    t /= np.linalg.norm(t)
    return Body(mu, 0, origin=np.asarray(origin, float), rotation=np.stack([t, np.cross(n, t), n], axis=1))


def sphere(mu: float, radius: float, *, origin: ArrayLike = (0.0, 0.0, 0.0), rotation: ArrayLike | None = None) -> Body:
    """Return a ball, which carries what sticks to it when its rotation (3, 3) changes from step to step."""
    if not (np.isfinite(radius) and radius > 0.0):
        raise ValueError(f"radius: must be finite and > 0, got {radius}")
    turn = np.eye(3) if rotation is None else np.asarray(rotation, float)
    return Body(mu, 1, (radius, 0.0, 0.0), np.asarray(origin, float), turn)


def cylinder(
    mu: float, radius: float, *, origin: ArrayLike = (0.0, 0.0, 0.0), rotation: ArrayLike | None = None
) -> Body:
    """Return a cylinder without ends, whose axis is the last column of its rotation (3, 3)."""
    if not (np.isfinite(radius) and radius > 0.0):
        raise ValueError(f"radius: must be finite and > 0, got {radius}")
    turn = np.eye(3) if rotation is None else np.asarray(rotation, float)
    return Body(mu, 3, (radius, 0.0, 0.0), np.asarray(origin, float), turn)


def box(mu: float, size: ArrayLike, *, origin: ArrayLike = (0.0, 0.0, 0.0), rotation: ArrayLike | None = None) -> Body:
    """Return a box with edges of `size` (3,) [m]."""
    half = 0.5 * np.asarray(size, float)
    if half.shape != (3,) or not (np.isfinite(half).all() and (half > 0.0).all()):
        raise ValueError(f"size: must be three finite lengths > 0, got {size!r}")
    turn = np.eye(3) if rotation is None else np.asarray(rotation, float)
    return Body(mu, 2, (half[0], half[1], half[2]), np.asarray(origin, float), turn)


SELF_FRICTION = 0.5
"""Coefficient of friction of a cloth with itself in a scene, unless another is asked for: the middle of the two, of
cloth on cloth, with which the thesis simulates shawls, 0.3 and 0.7 [thesis, Fig. 4.16]."""

BEARING: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"all": (1.0, 1.0), "vertices": (0.9, 1.0), "first": (0.9, 0.9)}
)
"""What edges of two sheets, and vertices of the later over the earlier, keep of the thickness: see `SelfContact`."""


@dataclass(frozen=True, eq=False)
class SelfContact:
    """How cloth feels itself and other cloth: nothing crosses, with exact Coulomb friction.

    Raises:
        ValueError: A number breaks its rule.
    """

    mu: float | ArrayLike
    """Coefficient of friction, 0 ... 10; of several sheets, those of each two: (S, S), symmetric. Sheets are the pieces
    of the mesh that hang together, in the order of their first vertices."""

    thickness: float | ArrayLike = THICKNESS
    """Of the sheets [m], or of each: (S,). Two sheets stay the mean of theirs apart, from middle to middle; a sheet of
    its own must be less than the distance at rest of any of its vertices and edges that do not meet."""

    bearing: str = "all"
    """What keeps two sheets the thickness apart. "all": vertices, and edges that cross. "vertices": those of both
    sheets; edges keep 0.9 of it. "first": the vertices of the earlier sheet; the rest keeps 0.9 of it. Where sheets lie
    on each other over large, smooth faces, "vertices" and "first" converge in fewer iterations. Choose "first" only
    where these are flat: over curved cloth its forces are rough. Within a sheet all bear."""

    def __post_init__(self) -> None:
        if self.bearing not in BEARING:
            raise ValueError(f"bearing: must be one of {', '.join(BEARING)}, got {self.bearing!r}")
        mu = np.asarray(self.mu, float)
        if not ((mu >= 0.0) & (mu <= MU_MAX)).all():
            raise ValueError(f"mu: must be in [0, {MU_MAX:g}], got {mu.tolist()}")
        if mu.ndim and not (mu.ndim == 2 and mu.shape[0] == mu.shape[1] and (mu == mu.T).all()):
            raise ValueError(f"mu: must be a number or a symmetric matrix, got {mu.tolist()}")
        thickness = np.asarray(self.thickness, float)
        if thickness.ndim > 1 or not (np.isfinite(thickness) & (thickness > 0.0)).all():
            raise ValueError(f"thickness: must be finite and > 0, one or one a sheet, got {thickness.tolist()}")

    def of_sheets(self, sheets: int) -> tuple[Floats, Floats]:
        """Return mu of each two of so many sheets (S, S), and their thicknesses (S,) [m].

        Raises:
            ValueError: There are more or less in `mu` or in `thickness`.
        """
        mu, thickness = np.asarray(self.mu, float), np.asarray(self.thickness, float)
        if mu.ndim and mu.shape != (sheets, sheets):
            raise ValueError(f"mu: must be of {sheets} sheets, got {mu.tolist()}")
        if thickness.ndim and thickness.shape != (sheets,):
            raise ValueError(f"thickness: must be of {sheets} sheets, got {thickness.tolist()}")
        return np.broadcast_to(mu, (sheets, sheets)).copy(), np.broadcast_to(thickness, sheets).copy()


@dataclass(frozen=True, eq=False)
class Surface:
    """Triangles that cloth touches, from either side, and whose vertices move as you say: a body of any shape.

    It may be open or closed, cross itself, and bend as it moves. Nothing tells its inside from its outside: cloth that
    starts on one side stays there.

    Vertices of the cloth touch a smooth surface through the vertices of the triangles, as they touch a body. Triangles
    themselves are only felt where they come nearer to the cloth than a quarter of that, between its vertices: there the
    cloth keeps this distance by pairs of closest points (see `SelfContact`). Nothing crosses the triangles.

    Raises:
        ValueError: An argument breaks its rule.
    """

    triangles: ArrayLike
    """(T, 3): vertices of each triangle."""

    positions: ArrayLike | Callable[[float], ArrayLike]
    """(N, 3) [m], or a function of the time [s] that returns them. In each step vertices move on straight lines."""

    mu: float | ArrayLike
    """Coefficient of friction with the cloth, 0 ... 10; or with each of its sheets: (S,)."""

    thickness: float = THICKNESS
    """Of a skin around the triangles, half of it on each side [m]: cloth stays half of this and half of its own
    thickness away from them. May be 0."""

    crease: float = CREASE
    """Edges stay sharp where the normals of their triangles are further apart at time 0, 0 ... pi [rad]. Borders are
    sharp."""

    def __post_init__(self) -> None:
        mu = np.asarray(self.mu, float)
        if mu.ndim > 1 or not ((mu >= 0.0) & (mu <= MU_MAX)).all():
            raise ValueError(f"mu: must be in [0, {MU_MAX:g}], one or one a sheet, got {mu.tolist()}")
        if not (np.isfinite(self.thickness) and self.thickness >= 0.0):
            raise ValueError(f"thickness: must be finite and >= 0, got {self.thickness}")
        if not 0.0 <= self.crease <= np.pi:
            raise ValueError(f"crease: must be in [0, pi] rad, got {self.crease}")
        triangles = np.array(self.triangles, dtype=np.int32)
        if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles):
            raise ValueError(f"triangles: must be (T, 3) numbers of vertices, got shape {triangles.shape}")
        object.__setattr__(self, "triangles", triangles)
        corners = self.at(0.0)
        if triangles.min() < 0 or triangles.max() >= len(corners):
            raise ValueError(
                f"triangles: must index {len(corners)} vertices, got {triangles.min()} ... {triangles.max()}"
            )
        a, b, c = np.moveaxis(corners[triangles], 1, 0)
        flat = np.flatnonzero(np.linalg.norm(np.cross(b - a, c - a), axis=1) == 0.0)
        if len(flat):
            raise ValueError(f"triangles: must have an area, and triangle {flat[0]} has none")

    def at(self, time: float) -> Floats:
        """Return the positions of the vertices at a time [s]: (N, 3) [m].

        Raises:
            ValueError: They are not (N, 3) or not finite.
        """
        found = np.ascontiguousarray(self.positions(time) if callable(self.positions) else self.positions, dtype=float)
        if found.ndim != 2 or found.shape[1] != 3:
            raise ValueError(f"positions: must be (N, 3), got shape {found.shape} at {time:g} s")
        if not np.isfinite(found).all():
            raise ValueError(f"positions: must be finite, and are not at {time:g} s")
        return found


@dataclass(frozen=True, eq=False)
class PairForces:
    """Forces of cloth on cloth and surfaces: P pairs of closest points."""

    vertices: NDArray[np.int32]
    """(P, 4); those of surfaces come after those of the cloth."""

    weights: Floats
    """(P, 4): the force acts on each vertex by its weight."""

    forces: Floats
    """(P, 3) [N]"""

    distance: Floats
    """(P,) [m]"""

    sliding: NDArray[np.bool_]
    """(P,)"""


Motion = Callable[[float], tuple[Floats, ArrayLike, Sequence[Body]]]
"""What drives a cloth at a time [s]: gravity (V, 3), positions of held vertices (K, 3), bodies."""


class Cloth:
    """Cloth, its state, and the settings by which it is stepped: a sheet, or several in one mesh.

    Args:
        mesh: The cloth at rest; `meshes.together` puts several sheets into one.
        fabric: What it is made of; or what each sheet is made of: sheets are the pieces of the mesh that hang together,
            in the order of their first vertices.
        preset: Solver settings.
        held: (K,) vertices whose positions are prescribed.
        clamped: (E, 2) boundary edges across which the slope is prescribed: the derivative of the position along the
            outward normal of the rest plane.
        self_contact: How it feels itself, and its sheets each other; None: it does not, and passes through itself.
        surfaces: Triangles that it touches. They are where they are at the time of the cloth.
        force_scale: Force that residuals are measured in [N]; None is the weight of 25 mm^2 of the lightest fabric.
        kernel: Level of the kernels, one of `_sim_core.cloth_kernels()`: levels differ in the last digits. None takes
            that of the environment variable STICKSLIP_CLOTH_KERNEL, or else the widest that this processor runs.

    Raises:
        ValueError: An argument breaks its rule.
    """

    def __init__(
        self,
        mesh: Mesh,
        fabric: Fabric | Sequence[Fabric],
        preset: SolverSettings,
        *,
        held: ArrayLike = (),
        clamped: ArrayLike | None = None,
        self_contact: SelfContact | None = None,
        surfaces: Sequence[Surface] = (),
        force_scale: float | None = None,
        kernel: str | None = None,
    ) -> None:
        self.mesh, self.preset = mesh, preset
        self.fabrics = (fabric,) if isinstance(fabric, Fabric) else tuple(fabric)
        """One, or one of each sheet."""
        self.held = np.asarray(held, dtype=np.int32).reshape(-1)
        edges = np.empty((0, 2), np.int32) if clamped is None else np.asarray(clamped, dtype=np.int32)
        self.slopes = np.zeros((len(edges), 3))
        check_mesh(mesh.rest, mesh.triangles)
        self.surfaces = tuple(surfaces)
        self.self_contact = self_contact
        self.time = 0.0
        """[s]"""
        self._surface_sizes = sizes = [len(surface.at(self.time)) for surface in self.surfaces]
        corners = [np.asarray(surface.triangles) for surface in self.surfaces]
        mu, thickness = self._touch(sheet_count(mesh.rest, mesh.triangles))
        edge_share, second_share = BEARING[self_contact.bearing if self_contact else "all"]
        patch_weight = min((fabric.density for fabric in self.fabrics), default=np.nan) * RESIDUAL_PATCH * GRAVITY
        self.force_scale = patch_weight if force_scale is None else force_scale
        """Force that residuals are measured in [N]: the weight of 25 mm^2, unless another is given."""
        self._solver = ClothSolver(
            mesh.rest,
            mesh.triangles,
            [(fabric.density, fabric.stretching, fabric.rigidity, fabric.damping) for fabric in self.fabrics],
            self.held.tolist(),
            edges,
            tolerance=preset.tolerance * self.force_scale,
            newton_max=preset.newton_max,
            krylov_max=preset.krylov_max,
            krylov_tolerance=preset.krylov_tolerance,
            refactor_after=preset.refactor_after,
            patience=preset.patience,
            halvings_max=preset.halvings_max,
            step_error=preset.step_error or 1.0,
            coarsest=preset.coarsest,
            finest=preset.finest,
            kernel=os.environ.get(KERNEL_VARIABLE, "") if kernel is None else kernel,
            thickness=thickness.tolist(),
            mu=mu,
            edge_share=edge_share,
            second_share=second_share,
            surface_triangles=np.concatenate(
                [np.empty((0, 3), np.int32), *(c + sum(sizes[:s]) for s, c in enumerate(corners))], dtype=np.int32
            ),
            surface_of_vertex=np.repeat(np.arange(len(sizes)), sizes).tolist(),
            surface_positions=self._surfaces_at(self.time),
            crease=[surface.crease for surface in self.surfaces],
        )
        self.least_distance = np.inf
        """Of pieces of cloth that do not hang together, and of cloth and surfaces, at the ends of all steps [m]; inf
        where none came near."""
        self.steps = self.unconverged_steps = 0
        self.worst_residual = 0.0
        """Largest residual force of a node in any step, over `force_scale`."""
        self.newton = self.krylov = self.flips = self.halvings = 0
        self.factorizations = 0.0
        """Whole ones, and shares of those in part."""
        self.gravity = np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1))

    def _touch(self, sheets: int) -> tuple[Floats | None, Floats]:
        """Return mu of each two sheets and surfaces, or None; -1 where they do not feel each other; and thicknesses."""
        if not self.self_contact and not self.surfaces:
            return None, np.empty(0)
        mu = np.full((sheets + len(self.surfaces),) * 2, -1.0)
        thickness = np.full(sheets, THICKNESS)
        if self.self_contact:
            mu[:sheets, :sheets], thickness = self.self_contact.of_sheets(sheets)
        for column, surface in enumerate(self.surfaces, start=sheets):
            own = np.asarray(surface.mu, float)
            if own.ndim and own.shape != (sheets,):
                raise ValueError(f"mu: of a surface must be one or of {sheets} sheets, got {own.tolist()}")
            mu[:sheets, column] = mu[column, :sheets] = own
        return mu, np.append(thickness, [surface.thickness for surface in self.surfaces])

    def _surfaces_at(self, time: float) -> Floats:
        found = [surface.at(time) for surface in self.surfaces]
        if [len(one) for one in found] != self._surface_sizes:
            raise ValueError(f"positions: of surfaces must keep their vertices, and do not at {time:g} s")
        return np.concatenate([np.empty((0, 3)), *found])

    @property
    def kernel(self) -> str:
        """Level of the kernels that step it."""
        return str(self._solver.kernel())

    @property
    def masses(self) -> Floats:
        """(V,) [kg]."""
        return np.asarray(self._solver.masses())

    @property
    def positions(self) -> Floats:
        """(V, 3) [m]."""
        return np.asarray(self._solver.positions())

    @property
    def velocities(self) -> Floats:
        """(V, 3) [m/s]."""
        return np.asarray(self._solver.velocities())

    @property
    def reactions(self) -> Floats:
        """(V, 3) [N]: force of a body or a smooth surface on a free vertex, of its holder on a held one, by M a =
        forces."""
        return np.asarray(self._solver.reactions())

    @property
    def contacts(self) -> NDArray[np.int32]:
        """(V,): body that a vertex touches, or surface, which are counted after the bodies; -1 where none."""
        return np.asarray(self._solver.contacts(), dtype=np.int32)

    @property
    def sliding(self) -> NDArray[np.bool_]:
        """(V,): whether a vertex slides on its body or surface."""
        return np.asarray(self._solver.sliding(), dtype=bool)

    @property
    def pair_forces(self) -> PairForces:
        """Forces of pairs of closest points, of cloth and cloth and of cloth and triangles of surfaces, at the end of
        the last step."""
        vertices, weights, forces, distance, sliding = self._solver.pair_forces()
        return PairForces(vertices, weights, forces, distance, np.asarray(sliding, dtype=bool))

    @property
    def surface_forces(self) -> list[Floats]:
        """Forces of the cloth on the vertices of each surface at the end of the last step: (N, 3) [N]."""
        return np.split(np.asarray(self._solver.surface_forces()), np.cumsum(self._surface_sizes)[:-1])

    def set_state(
        self, positions: ArrayLike, velocities: ArrayLike | None = None, slopes: ArrayLike | None = None
    ) -> None:
        """Put the cloth somewhere: positions (V, 3), velocities (V, 3), slopes at clamped edges (E, 3).

        Surfaces are where they are at the time of the cloth.

        Raises:
            ValueError: The cloth crosses a surface, or itself although it feels itself; or an array has another shape.
        """
        at = np.asarray(positions, float)
        speed = np.zeros_like(at) if velocities is None else np.asarray(velocities, float)
        if slopes is not None:
            self.slopes = np.asarray(slopes, float)
        self._solver.set_state(at, speed, self.slopes, self._surfaces_at(self.time))

    def step(
        self,
        dt: float,
        *,
        held: ArrayLike = (),
        bodies: Sequence[Body] = (),
        slopes: ArrayLike | None = None,
        damping: float = 0.0,
    ) -> StepReport:
        """Advance by dt [s]; positions of held vertices (K, 3), slopes and bodies are those at its end.

        In the first step after `set_state` bodies are taken to have been where they are. Surfaces move to where they
        are at the end of the step.

        `damping` is proportional to mass [1/s]; that of the fabric is added.
        A step that does not converge is counted and its best iterate kept.
        """
        if slopes is not None:
            self.slopes = np.asarray(slopes, float)
        ends = np.asarray(held, float).reshape(-1, 3)
        report = self._solver.step(
            dt,
            self.gravity,
            ends,
            self.slopes,
            self._surfaces_at(self.time + dt),
            [body.as_tuple() for body in bodies],
            damping,
        )
        self.time += dt
        return self._count(report)

    def advance(self, end: float, motion: Motion, *, damping: float = 0.0) -> StepReport:
        """Advance to `end` [s] by steps that share the interval and end with it: the controller's, or the preset's.

        All intervals must be equally long. `motion` takes a time [s] and returns what holds at it: gravity (V, 3)
        [m/s^2], positions of the held vertices (K, 3) [m], and the bodies.
        """

        def drive(time: float) -> tuple[Floats, Floats, Floats, Floats, list[BodyTuple]]:
            gravity, held, bodies = motion(time)
            ends = np.asarray(held, float).reshape(-1, 3)
            return gravity, ends, self.slopes, self._surfaces_at(time), [body.as_tuple() for body in bodies]

        if self.preset.step_error is None:
            report = self._advance_evenly(end, motion, damping)
        else:
            report = self._count(self._solver.advance(self.time, end, drive, damping))
            self.gravity = motion(end)[0]
        self.time = end
        return report

    def _advance_evenly(self, end: float, motion: Motion, damping: float) -> StepReport:
        begin = self.time
        steps = max(1, int(np.ceil((end - begin) / self.preset.time_step * (1.0 - 1e-9))))
        for step in range(1, steps + 1):
            self.gravity, held, bodies = motion(begin + (end - begin) * step / steps)
            report = self.step((end - begin) / steps, held=held, bodies=bodies, damping=damping)
        return report

    def contact_force(self) -> Floats:
        """Return the force of bodies and surfaces on the cloth [N] in the last step.

        It is the change of momentum less weight and holders.
        """
        holders = self.reactions[self.held].sum(axis=0)
        weight = (self.masses[:, None] * self.gravity).sum(axis=0)
        force: Floats = np.asarray(self._solver.momentum_rate()) - weight - holders
        return force

    def _count(self, report: StepReport) -> StepReport:
        self.steps += report.steps
        self.unconverged_steps += report.unconverged
        residual = report.residual / self.force_scale
        if not residual <= self.worst_residual:  # a NaN stays
            self.worst_residual = residual
        self.newton += report.newton
        self.krylov += report.krylov
        self.factorizations += report.factorizations
        self.flips += report.flips
        self.halvings += report.halvings
        self.least_distance = min(self.least_distance, report.least_distance)
        return report

    def softest(self) -> float:
        """Return the smallest eigenvalue of stiffness over mass here, without contact [1/s^2]; > 0 means stable."""
        return float(self._solver.softest(self.positions, self.slopes))

    def why_invalid(self, path: Floats) -> str:
        """Return why a simulation with these positions (frames, V, 3) is not valid, or an empty text."""
        if not np.isfinite(path).all():
            return f"positions are not finite from frame {len(path) - 1} on"
        if self.unconverged_steps > self.preset.unconverged_share_max * self.steps:
            return (
                f"{self.unconverged_steps} of {self.steps} steps did not converge, "
                f"and {self.preset.name} allows a share of {self.preset.unconverged_share_max:g}"
            )
        return ""

    def phases(self) -> dict[str, float]:
        """Return CPU seconds by phase since the start."""
        return dict(zip(("assembly", "factorization", "krylov", "contact"), self._solver.phases(), strict=True))
