"""Holders: vertices of the cloth that move as rigid bodies.

Cloth starts in the shape in which it hangs at rest under them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

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

    At the time t0 of the grasp the holder takes each vertex where it is: x(t) = M(t) M(t0)^-1
    x(t0), M being its pose.

    Raises:
        ValueError: An argument breaks its rule.
    """

    vertices: NDArray[np.intp]
    """(K,)"""

    pose: Callable[[ArrayLike], Floats]
    """From the time [s] to a rigid motion (3, 4): x -> A x + b [m]; in a scene with `poses`, from
    times (T,), too.
    """

    grasp: tuple[float, float] = ALWAYS
    """When it takes hold, and when it lets go [s]."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.grasp[0] < self.grasp[1]:
            raise ValueError(f"grasp: must ascend from 0 s or later, got {list(self.grasp)}")
        if not len(self.vertices):
            raise ValueError("vertices: a holder must hold a vertex, got none")

    def holds(self, time: float) -> bool:
        """Return whether it holds its vertices from this time [s] on."""
        return self.grasp[0] <= time < self.grasp[1]


class Hands:
    """The holders of a scene, with the vertices that each holds now.

    No two holders may hold the same vertex at a time.

    `positions` are those of all vertices at 0 s, (V, 3) [m].
    """

    def __init__(self, holders: Sequence[Holder], positions: Floats) -> None:
        self.holders = tuple(holders)
        self.events = sorted({t for holder in holders for t in holder.grasp if 0.0 < t < np.inf})
        """Times of all grasps and releases after 0 s [s], ascending."""
        self._taken: dict[int, Floats] = {}
        self.take(0.0, positions)

    def take(self, time: float, positions: Floats) -> NDArray[np.int32]:
        """Grasp and release what this time [s] asks for, and return the held vertices (K,)."""
        taken: dict[int, Floats] = {}
        for number, holder in enumerate(self.holders):
            if holder.holds(time):
                pose = holder.pose(time)
                place = (positions[holder.vertices] - pose[:, 3]) @ pose[:, :3]
                taken[number] = self._taken.get(number, place)
        self._taken = taken
        return self.vertices

    @property
    def vertices(self) -> NDArray[np.int32]:
        """(K,): held vertices, holder by holder."""
        held = [self.holders[number].vertices for number in self._taken]
        return np.concatenate([np.empty(0, np.int32), *held], dtype=np.int32)

    def at(self, time: ArrayLike) -> Floats:
        """Return the positions of the held vertices at a time or times [s]: ([T,] K, 3) [m].

        Times are (T,).
        """
        shape = np.shape(time)
        found = [np.empty((*shape, 0, 3))]
        for number, points in self._taken.items():
            pose = np.broadcast_to(self.holders[number].pose(time), (*shape, 3, 4))
            found.append(points @ np.swapaxes(pose[..., :3], -1, -2) + pose[..., None, :, 3])
        return np.concatenate(found, axis=-2)

    def driving(self, motion: Callable[[float], tuple[Floats, Sequence[Body]]]) -> Motion:
        """Add the positions of held vertices to a motion, which returns gravity and bodies."""

        def drive(time: float) -> tuple[Floats, Floats, Sequence[Body]]:
            gravity, bodies = motion(time)
            return gravity, self.at(time), bodies

        return drive


HANGING = SolverSettings("hanging", 0.05, tolerance=1e-5, step_error=None, halvings_max=1)
"""Solver settings of the hung shape, so that all presets start from the same. The way there does
not matter, so hard steps are not pursued far."""

HANGING_TILTS = (30.0, 10.0, 3.0, 1.0)
"""Factors of the bias, in turn: with a large bias the cloth has one shape, which is followed as the
bias falls.
"""

SETTLING_STEPS = 25
"""Steps with each factor."""

SETTLING_DAMPING = 5.0
"""Damping of these steps [1/s]."""

FIRST_STEP = 0.002
"""First step [s]: the flat cloth buckles when it is released."""

GROWTH = 1.3
"""Growth of the next steps, up to 50 ms."""

LONGEST = 1.0
"""Steps of the settled cloth grow to this length [s]."""

AT_REST = 1e-8
"""Cloth is at rest when no vertex moves further than this in a step [m]."""

HANGING_STEPS_MAX = 400
"""The search for rest ends after this number of steps."""


@dataclass(frozen=True, eq=False)
class Hung:
    """The shape of a cloth at rest under its holders."""

    positions: Floats
    """(V, 3) [m]"""

    held: NDArray[np.intp]
    """Vertices under the holders."""

    side: int
    """Side that the tilt is to, 1 or -1."""

    bias: float
    """Size of the tilt."""

    tilt: Floats
    """(V, 3): gravity along the normal, over that along -z, which breaks the symmetry of what
    follows.
    """

    reason: str
    """Reason why it is no stable equilibrium, or empty."""


def hung(
    mesh: meshes.Mesh,
    fabric: Fabric,
    flat: Floats,
    held: NDArray[np.intp],
    *,
    normal: ArrayLike,
    seed: int,
    kernel: str | None = None,
) -> Hung:
    """Return the shape at rest, under gravity along -z, of a cloth that is let down.

    The cloth is flat at first.

    A cloth that is held at two corners has many shapes at rest. This one is reached as a tilt of
    gravity falls from 30 times a bias to the bias, which is drawn from the seed. It is settled
    until nothing moves, and its stability is checked.

    Args:
        mesh: Of a single sheet.
        fabric: Of the sheet.
        flat: (V, 3): positions of the flat sheet [m].
        held: (K,): vertices under the holders.
        normal: (3,): of the flat sheet, the direction of the tilt.
        seed: Of the bias.
        kernel: Level of the kernels, see `Cloth`.
    """
    cloth = Cloth(mesh, fabric, HANGING, held=held, kernel=kernel)
    rng = np.random.default_rng(seed)
    side = 1 if rng.random() < 0.5 else -1
    bias = float(rng.uniform(1e-3, 3e-3))
    twist = float(rng.uniform(-0.3, 0.3))
    tilt = side * bias * (1.0 + twist * mesh.rest[:, 0] / np.abs(mesh.rest[:, 0]).max())
    tilts = tilt[:, None] * np.asarray(normal, float)
    down = np.tile([0.0, 0.0, -GRAVITY], (len(mesh.rest), 1))
    cloth.set_state(flat)
    dt = FIRST_STEP
    for times in HANGING_TILTS:
        cloth.gravity = down + times * tilts * GRAVITY
        for _ in range(SETTLING_STEPS):
            cloth.step(dt, held=flat[held], damping=SETTLING_DAMPING)
            dt = min(GROWTH * dt, HANGING.time_step)
    moved = np.inf
    steps = 0
    while (dt < LONGEST or moved > AT_REST) and steps < HANGING_STEPS_MAX:
        before = cloth.positions
        dt = min(1.5 * dt, LONGEST)
        cloth.step(dt, held=flat[held], damping=SETTLING_DAMPING)
        moved = float(np.abs(cloth.positions - before).max())
        steps = steps + 1
    softest = cloth.softest()
    reason = ""
    if not moved <= AT_REST:
        reason = f"the hung cloth did not come to rest: it moved by {moved:.1e} m in {dt:g} s"
    elif not softest > 0.0:
        reason = f"the hung cloth is not stable: its softest eigenvalue is {softest:.2g} 1/s^2"
    return Hung(cloth.positions, held, side, bias, tilts, reason)
