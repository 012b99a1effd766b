"""Evenness of the driving motions, in a step that goes on beyond the last frame.

The solver measures how far holders, bodies and surfaces are from an even motion in each step. A
step does not end at the last frame, and what happens after the frame is no part of the run: a
holder may stop at the very end of a scene.
"""

from collections.abc import Sequence

import numpy as np

from stickslip_sim_core._sim_core import body_gaps
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.solver import Cloth, Motion

LOOKS = 8
"""Number of instants at which the motion is looked at.

A jump is seen with 7/8 of its length or more.
"""


def uneven_until(end: float, cloth: Cloth, motion: Motion) -> float | None:
    """Return the largest distance from an even motion between the start of the last step and `end`.

    The distance [m] is that of held vertices, surfaces and those points of bodies at which the
    cloth is. It is None if the last step does not go beyond `end` [s].
    """
    begin = cloth.last_begin
    if not begin < end < cloth.time:
        return None
    shares = np.arange(LOOKS + 1) / LOOKS
    paths = []
    touched = _touched(cloth, motion(end)[2])
    for share in shares:
        time = begin + share * (end - begin)
        _, held, bodies = motion(time)
        points = [np.reshape(np.asarray(held, float), (-1, 3))]
        points += [surface.at(time) for surface in cloth.surfaces]
        for body, local in zip(bodies, touched, strict=True):
            points.append(local @ np.asarray(body.rotation).T + np.asarray(body.origin))
        paths.append(np.concatenate(points))
    path = np.stack(paths)
    even = path[0] + shares[:, None, None] * (path[-1] - path[0])
    return float(np.linalg.norm(path - even, axis=2).max(initial=0.0))


def _touched(cloth: Cloth, bodies: Sequence[Body]) -> list[Floats]:
    """Return the vertices near each body, in its own axes: (N, 3) [m]."""
    positions = cloth.positions
    extent = float(np.ptp(positions, axis=0).max())
    touched = []
    for body in bodies:
        near = body_gaps(body.as_tuple(), positions)[0] < extent
        touched.append((positions[near] - np.asarray(body.origin)) @ np.asarray(body.rotation))
    return touched
