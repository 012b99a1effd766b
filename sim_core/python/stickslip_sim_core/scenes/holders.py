"""Holders: vertices of the cloth that move as rigid bodies.

`hung` returns the shape in which a cloth hangs at rest under its holders.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth, Motion

ALWAYS = (0.0, np.inf)


@dataclass(frozen=True, eq=False)
class Holder:
    """Vertices that move as one rigid body from a grasp to a release.

    At the time t0 of the grasp the holder takes each vertex at its present position. From then on
    x(t) = M(t) M(t0)^-1 x(t0), with the pose M of the holder.

    Raises:
        ValueError: An argument breaks its rule.
    """

    vertices: NDArray[np.intp]
    """Vertices that the holder holds: (K,)."""

    pose: Callable[[ArrayLike], Floats]
    """Function from a time [s] to a rigid motion x -> A x + b [m]: (3, 4).

    In a scene with `poses` it takes times (T,), too.
    """

    grasp: tuple[float, float] = ALWAYS
    """Times of the grasp and of the release [s]."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.grasp[0] < self.grasp[1]:
            raise ValueError(f"grasp: must ascend from 0 s or later, got {list(self.grasp)}")
        if not len(self.vertices):
            raise ValueError("vertices: a holder must hold a vertex, got none")

    def holds(self, time: float) -> bool:
        """Return whether the holder holds its vertices from this time [s] on."""
        return self.grasp[0] <= time < self.grasp[1]


class Hands:
    """The holders of a scene, with the vertices that each holds now.

    No two holders may hold the same vertex at a time.

    `positions` are the positions of all vertices at 0 s: (V, 3) [m].
    """

    def __init__(self, holders: Sequence[Holder], positions: Floats) -> None:
        self.holders = tuple(holders)
        self.events = sorted({t for holder in holders for t in holder.grasp if 0.0 < t < np.inf})
        """Times of all grasps and releases after 0 s [s], ascending."""
        # By the number of a holder: places of its vertices in the axes of the holder, (K, 3) [m].
        self._points_by_holder: dict[int, Floats] = {}
        self.take(0.0, positions)

    def take(self, time: float, positions: Floats) -> NDArray[np.int32]:
        """Grasp and release the vertices due at this time [s], and return the held ones (K,)."""
        points_by_holder: dict[int, Floats] = {}
        for number, holder in enumerate(self.holders):
            if holder.holds(time):
                pose = holder.pose(time)
                place = (positions[holder.vertices] - pose[:, 3]) @ pose[:, :3]
                # A holder keeps the places from its grasp: new ones at each event would drift.
                points_by_holder[number] = self._points_by_holder.get(number, place)
        self._points_by_holder = points_by_holder
        return self.vertices

    @property
    def points(self) -> Mapping[int, Floats]:
        """Places of held vertices in the axes of their holders (K, 3) [m], by number of holder."""
        return self._points_by_holder

    @property
    def vertices(self) -> NDArray[np.int32]:
        """Held vertices, holder by holder: (K,)."""
        held = [self.holders[number].vertices for number in self._points_by_holder]
        return np.concatenate([np.empty(0, np.int32), *held], dtype=np.int32)

    def at(self, time: ArrayLike) -> Floats:
        """Return the positions of the held vertices at a time or times [s]: ([T,] K, 3) [m].

        Several times are (T,).
        """
        # Empty arrays keep the shape if no holder holds a vertex.
        shape = np.shape(time)
        placed_points = [np.empty((*shape, 0, 3))]
        for number, points in self._points_by_holder.items():
            # A holder at rest may return one pose for all times.
            pose = np.broadcast_to(self.holders[number].pose(time), (*shape, 3, 4))
            placed_points.append(
                points @ np.swapaxes(pose[..., :3], -1, -2) + pose[..., None, :, 3]
            )
        return np.concatenate(placed_points, axis=-2)

    def driving(self, motion: Callable[[float], tuple[Floats, Sequence[Body]]]) -> Motion:
        """Add the positions of held vertices to a motion, which returns gravity and bodies."""

        def drive(time: float) -> tuple[Floats, Floats, Sequence[Body]]:
            gravity, bodies = motion(time)
            return gravity, self.at(time), bodies

        return drive


HANGING = SolverSettings("hanging", 0.05, tolerance=1e-5, step_error=None, halvings_max=1)
"""Solver settings of the hung shape. All presets start from this shape.

The path to rest does not matter, so the solver does not pursue hard steps far.
"""

HANGING_TILTS = (30.0, 10.0, 3.0, 1.0)
"""Factors of the bias, in turn.

With a large bias the cloth has one shape, and it follows this shape as the bias falls.
"""

SETTLING_STEPS = 25
"""Number of steps with each factor."""

SETTLING_DAMPING = 5.0
"""Damping until the cloth is at rest [1/s]."""

FIRST_STEP = 0.002
"""Length of the first step [s]. It is short because the flat cloth buckles at its release."""

GROWTH = 1.3
"""Growth of the next steps, up to 50 ms."""

LONGEST = 1.0
"""Length to which steps of the settled cloth grow [s]."""

AT_REST = 1e-8
"""Cloth is at rest when no vertex moves further than this in a step [m]."""

HANGING_STEPS_MAX = 400
"""The search for rest ends after this number of steps."""


@dataclass(frozen=True, eq=False)
class Hung:
    """The shape of a cloth at rest under its holders."""

    positions: Floats
    """Positions of the vertices: (V, 3) [m]."""

    held: NDArray[np.intp]
    """Vertices under the holders."""

    side: int
    """Side of the tilt, 1 or -1."""

    bias: float
    """Size of the tilt."""

    tilt: Floats
    """Gravity along the normal over gravity along -z: (V, 3).

    It breaks the symmetry of the motion that follows.
    """

    gravity: Floats
    """Acceleration of gravity under which it hangs, with the tilt: (V, 3) [m/s^2]."""

    reason: str
    """Reason why the shape is no stable equilibrium, or empty."""


class Hang(Protocol):
    """A way to let a flat cloth hang: `hung`, or `flat_under_tilt`."""

    def __call__(
        self,
        mesh: meshes.Mesh,
        fabric: Fabric,
        flat: Floats,
        held: NDArray[np.intp],
        *,
        normal: ArrayLike,
        seed: int,
        gravity: ArrayLike = (0.0, 0.0, -GRAVITY),
        kernel: str | None = None,
    ) -> Hung: ...


def flat_under_tilt(
    mesh: meshes.Mesh,
    fabric: Fabric,
    flat: Floats,
    held: NDArray[np.intp],
    *,
    normal: ArrayLike,
    seed: int,
    gravity: ArrayLike = (0.0, 0.0, -GRAVITY),
    kernel: str | None = None,
) -> Hung:
    """Return the cloth that `hung` takes, still flat, with the tilt that it would hang under.

    Arguments and errors are those of `hung`. Nothing is simulated, so it serves for scenes of which
    only the holders and the tilt are needed.
    """
    size = float(np.linalg.norm(np.asarray(gravity, float)))
    # Without a weight the cloth would keep its flat shape, which is no shape of hanging.
    if not size > 0.0:
        raise ValueError(
            f"gravity: cloth can only hang under gravity, got {np.asarray(gravity).tolist()} m/s^2"
        )
    rng = np.random.default_rng(seed)
    side = 1 if rng.random() < 0.5 else -1
    bias = float(rng.uniform(1e-3, 3e-3))
    # The tilt differs from left to right by up to 30 %, so that no mirror symmetry remains either.
    twist = float(rng.uniform(-0.3, 0.3))
    tilt = side * bias * (1.0 + twist * mesh.rest[:, 0] / np.abs(mesh.rest[:, 0]).max())
    tilts = tilt[:, None] * np.asarray(normal, float)
    down = np.tile(np.asarray(gravity, float), (len(mesh.rest), 1))
    return Hung(flat, held, side, bias, tilts, down + tilts * size, "")


def hung(
    mesh: meshes.Mesh,
    fabric: Fabric,
    flat: Floats,
    held: NDArray[np.intp],
    *,
    normal: ArrayLike,
    seed: int,
    gravity: ArrayLike = (0.0, 0.0, -GRAVITY),
    kernel: str | None = None,
) -> Hung:
    """Return the shape at rest, under its gravity, of a cloth that is let down.

    The cloth is flat at first.

    A cloth that hangs from two corners has many shapes at rest. The search picks one of them: it
    tilts gravity by 30 times a bias, and then lowers the tilt to the bias, which is drawn from the
    seed. The cloth settles until nothing moves, and its stability is checked.

    Args:
        mesh: Mesh of a single sheet.
        fabric: Fabric of the sheet.
        flat: Positions of the flat sheet: (V, 3) [m].
        held: Vertices under the holders: (K,).
        normal: Normal of the flat sheet, which is the direction of the tilt: (3,).
        seed: Seed of the bias.
        gravity: Acceleration of gravity: (3,) [m/s^2].
        kernel: Level of the kernels, see `Cloth`.

    Raises:
        ValueError: Gravity is zero.
    """
    begin = flat_under_tilt(
        mesh, fabric, flat, held, normal=normal, seed=seed, gravity=gravity, kernel=kernel
    )
    size = float(np.linalg.norm(np.asarray(gravity, float)))
    down = np.tile(np.asarray(gravity, float), (len(mesh.rest), 1))
    cloth = Cloth(mesh, fabric, HANGING, held=held, kernel=kernel)
    cloth.set_state(flat)
    dt = FIRST_STEP
    for times in HANGING_TILTS:
        cloth.gravity = down + times * begin.tilt * size
        for _ in range(SETTLING_STEPS):
            cloth.step(dt, held=flat[held], damping=SETTLING_DAMPING)
            dt = min(GROWTH * dt, HANGING.time_step)
    # Rest counts only in a long step: in a short one, a slow cloth hardly moves either.
    moved = np.inf
    steps = 0
    while (dt < LONGEST or moved > AT_REST) and steps < HANGING_STEPS_MAX:
        before = cloth.positions
        dt = min(1.5 * dt, LONGEST)
        cloth.step(dt, held=flat[held], damping=SETTLING_DAMPING)
        moved = float(np.abs(cloth.positions - before).max())
        steps = steps + 1
    # A cloth may also be at rest on a saddle, and leave it at the first disturbance.
    softest = cloth.softest()
    reason = ""
    if not moved <= AT_REST:
        reason = f"the hung cloth did not come to rest: it moved by {moved:.1e} m in {dt:g} s"
    elif not softest > 0.0:
        reason = f"the hung cloth is not stable: its softest eigenvalue is {softest:.2g} 1/s^2"
    return replace(begin, positions=cloth.positions, reason=reason)


class Hanging(NamedTuple):
    """A sheet of a scene that hangs at the start."""

    sheet: int
    """Its number."""
    begin: int
    """Number of its first vertex among those of all sheets."""

    mesh: meshes.Mesh
    fabric: Fabric
    hung: Hung
