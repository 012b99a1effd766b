"""The shape of a cloth at rest under its holders, where a scene of hung cloth starts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth

HANGING = SolverSettings("hanging", 0.05, tolerance=1e-5, step_error=None, halvings_max=1)
"""Solver settings of the hung shape, so that all presets start from the same. The way there does not matter, so hard
steps are not pursued far."""

HANGING_TILTS = (30.0, 10.0, 3.0, 1.0)
"""Factors of the bias, in turn: with a large bias the cloth has one shape, which is followed as the bias falls."""

SETTLING_STEPS, SETTLING_DAMPING = 25, 5.0
"""Steps with each factor, and their damping [1/s]."""

FIRST_STEP, GROWTH = 0.002, 1.3
"""First step [s], and growth of the next ones up to 50 ms: the flat cloth buckles when it is released."""

LONGEST, AT_REST, HANGING_STEPS_MAX = 1.0, 1e-8, 400
"""Steps then grow to this length [s] until no vertex moves further than this in one [m]; at most so many steps."""


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
    """(V, 3): gravity along the normal, over that along -z, which breaks the symmetry of what follows."""

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
    """Return the shape at rest, under gravity along -z, of a cloth that is let down from where it is flat.

    A cloth that is held at two corners has many shapes at rest. This one is reached as a tilt of gravity falls from 30
    times a bias to the bias, which is drawn from the seed. It is settled until nothing moves, and its stability is
    checked.

    Args:
        mesh, fabric: Of one sheet.
        flat: (V, 3): where it is flat [m].
        held: (K,): vertices under the holders.
        normal: (3,): of the flat sheet, the direction of the tilt.
        seed, kernel: Of the bias; see `Cloth`.
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
    moved, steps = np.inf, 0
    while (dt < LONGEST or moved > AT_REST) and steps < HANGING_STEPS_MAX:
        before = cloth.positions
        dt = min(1.5 * dt, LONGEST)
        cloth.step(dt, held=flat[held], damping=SETTLING_DAMPING)
        moved, steps = float(np.abs(cloth.positions - before).max()), steps + 1
    softest = cloth.softest()
    reason = ""
    if not moved <= AT_REST:
        reason = f"the hung cloth did not come to rest: it moved by {moved:.1e} m in {dt:g} s"
    elif not softest > 0.0:
        reason = f"the hung cloth is not stable: its softest eigenvalue is {softest:.2g} 1/s^2"
    return Hung(cloth.positions, held, side, bias, tilts, reason)
