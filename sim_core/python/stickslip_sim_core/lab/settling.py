"""Cloth that comes to rest: steps that grow, and damping."""

from collections.abc import Sequence

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.solver import Cloth

FIRST_STEP = 0.02
"""Length of the first steps [s]: the cloth chooses its folds while it falls."""
STEADY_STEPS = 60
"""Usual number of steps of this length, before steps grow."""
GROWTH = 1.2
"""Ratio of a step to the one before. The scheme damps more in longer steps."""
LONGEST_STEP = 1.0
"""Largest step [s]."""
STEPS_MAX = 600
"""Steps after which a cloth that still moves is given up."""
DAMPING = 3.0
"""Damping in proportion to the mass [1/s]. It changes the path to rest, and not the rest."""


def settle(
    cloth: Cloth,
    held: Floats,
    *,
    rest: float,
    bodies: Sequence[Body] = (),
    steady_steps: int = STEADY_STEPS,
) -> bool:
    """Step a cloth until no vertex moves by `rest` [m] in a long step.

    Args:
        cloth: The cloth, with its state.
        held: Positions of the held vertices, which stay: (K, 3) [m].
        rest: Largest motion of a vertex in a step of more than half of `LONGEST_STEP` [m].
        bodies: Rigid bodies, which stay.
        steady_steps: Number of short steps at first, for a cloth that falls.

    Returns:
        Whether the cloth came to rest within `STEPS_MAX` steps.
    """
    dt = FIRST_STEP
    while cloth.total.steps < STEPS_MAX:
        before = cloth.positions
        cloth.step(dt, held=held, bodies=bodies, damping=DAMPING)
        moved = float(np.abs(cloth.positions - before).max())
        # Rest counts only in a long step: in a short one, slow cloth hardly moves either.
        if 2.0 * dt > LONGEST_STEP and moved < rest:
            return True
        if cloth.total.steps > steady_steps:
            dt = min(dt * GROWTH, LONGEST_STEP)
    return False
