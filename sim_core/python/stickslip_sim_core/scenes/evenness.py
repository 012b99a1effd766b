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
from stickslip_sim_core.rotations import matrices_of_vectors, vectors_of_matrices

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
    points = []
    bodies = []
    for share in shares:
        time = begin + share * (end - begin)
        _, held, now = motion(time)
        at = [np.reshape(np.asarray(held, float), (-1, 3))]
        at += [surface.at(time) for surface in cloth.surfaces]
        points.append(np.concatenate(at))
        bodies.append(now)
    path = np.stack(points)
    even = path[0] + shares[:, None, None] * (path[-1] - path[0])
    distances = [np.linalg.norm(path - even, axis=2).max(initial=0.0)]
    touched = _touched(cloth, bodies[-1])
    for number, local in enumerate(touched):
        poses = [_pose(at_one_time[number]) for at_one_time in bodies]
        distances.append(_uneven_body(poses, shares, local))
    return float(max(distances))


def _pose(body: Body) -> tuple[Floats, Floats]:
    return np.asarray(body.rotation, float), np.asarray(body.origin, float)


def _uneven_body(poses: Sequence[tuple[Floats, Floats]], shares: Floats, local: Floats) -> float:
    """Return the largest distance of points of a body (N, 3) from an even motion [m].

    Like the solver, it takes a body to move evenly if its origin is on a straight line and its turn
    is even. A point of an even turn goes on an arc.
    """
    (rotation_begin, origin_begin), (rotation_end, origin_end) = poses[0], poses[-1]
    (turn,) = vectors_of_matrices((rotation_end @ rotation_begin.T)[None])
    largest = 0.0
    for share, (rotation, origin), part in zip(
        shares, poses, matrices_of_vectors(shares[:, None] * turn), strict=True
    ):
        even_origin = origin_begin + share * (origin_end - origin_begin)
        change = rotation - part @ rotation_begin
        distances = np.linalg.norm(local @ change.T + origin - even_origin, axis=1)
        largest = max(largest, float(distances.max(initial=0.0)))
    return largest


def _touched(cloth: Cloth, bodies: Sequence[Body]) -> list[Floats]:
    """Return the vertices near each body, in its own axes: (N, 3) [m]."""
    positions = cloth.positions
    extent = float(np.ptp(positions, axis=0).max())
    touched = []
    for body in bodies:
        near = body_gaps(body.as_tuple(), positions)[0] < extent
        touched.append((positions[near] - np.asarray(body.origin)) @ np.asarray(body.rotation))
    return touched
