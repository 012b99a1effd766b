"""Positions of cloth at a frame, which lies between the two ends of a step.

Positions are cubic in time. A cubic continues the velocity before an impact, and may therefore
reach through the obstacle. Such a frame is straight in time, and what is in a body even then goes
to its face.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core._sim_core import body_gaps, self_intersections
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.solver import Cloth

DEPTH = 1e-5
"""Depth of a vertex in a body beyond which a frame is not shown as it is [m].

It is far below what a picture shows, and far above the gaps of solved steps, 1e-9 m. Cloth of the
default thickness keeps 0.06 mm at least from the triangles of a surface, so a path that is bent by
less does not reach them.
"""

Bodies = Callable[[float], Sequence[Body]]
"""Function of the time [s] that returns the bodies."""


class Frame(NamedTuple):
    """The shown state of a cloth at one time."""

    positions: Floats
    """(V, 3) [m]"""

    crossings: int
    """Number of pairs of triangles of the cloth that cross, or 0 without finite positions."""

    time: float
    straight: bool = False
    """Whether the positions are linear in time between the ends of the step."""


def frame_at(cloth: Cloth, time: float, bodies: Bodies) -> Frame:
    """Return the frame at a time [s] in the last step of `Cloth.advance`.

    No vertex is more than 0.01 mm inside a body, unless it is as deep at an end of the step, as a
    held vertex may be. Between the ends of a step, cloth crosses no other cloth and no surface.
    """
    smooth = cloth.positions_at(time)
    if not np.isfinite(smooth).all():
        return Frame(smooth, 0, time)
    crossings = self_intersections(smooth, cloth.mesh.triangles)
    # The end of a step is a result of the solver, and is shown as it is.
    if time == cloth.time:
        return Frame(smooth, crossings, time)
    here = bodies(time)
    straight = cloth.positions_at(time, straight=True)
    if (
        (crossings and cloth.self_contact is not None)
        or (_depths(smooth, here) > DEPTH).any()
        or _crosses_surfaces(cloth, time, smooth, straight)
    ):
        smooth = _out_of_bodies(cloth, straight, here, bodies)
        crossings = self_intersections(smooth, cloth.mesh.triangles)
        return Frame(smooth, crossings, time, straight=True)
    return Frame(smooth, crossings, time)


def _depths(positions: Floats, bodies: Sequence[Body]) -> Floats:
    """Return the largest depth of each position (V, 3) in a body, or 0: (V,) [m]."""
    deepest = np.zeros(len(positions))
    for body in bodies:
        np.maximum(deepest, -body_gaps(body.as_tuple(), positions)[0], out=deepest)
    return deepest


def _out_of_bodies(cloth: Cloth, positions: Floats, here: Sequence[Body], bodies: Bodies) -> Floats:
    """Return positions (V, 3) [m] that are in no body deeper than at the ends of the step."""
    # A body that turns or slows down in the step may come nearer than its straight path does.
    if not (_depths(positions, here) > DEPTH).any():
        return positions
    allowed = np.full(len(positions), DEPTH)
    for time in (cloth.last_begin, cloth.time):
        np.maximum(allowed, _depths(cloth.positions_at(time), bodies(time)), out=allowed)
    out = positions.copy()
    for body in here:
        distances, normals = body_gaps(body.as_tuple(), out)
        out += np.maximum(-distances - allowed, 0.0)[:, None] * normals
    return out


def _crosses_surfaces(cloth: Cloth, time: float, smooth: Floats, straight: Floats) -> bool:
    """Return whether cubic positions cross a surface that straight ones may not cross."""
    # The search takes as long as a step, and slow cloth bends its path by far less.
    if not cloth.surfaces or not np.abs(smooth - straight).max() > DEPTH:
        return False
    low = smooth.min(axis=0)
    high = smooth.max(axis=0)
    alone = self_intersections(smooth, cloth.mesh.triangles)
    for surface in cloth.surfaces:
        points = surface.at(time)
        near = _near(points, np.asarray(surface.triangles), low, high)
        both = np.concatenate([cloth.mesh.triangles, near + len(smooth)], dtype=np.int32)
        together = self_intersections(np.concatenate([smooth, points]), both)
        # A surface may cross itself, which is no crossing of the cloth.
        if together > alone + self_intersections(points, np.ascontiguousarray(near)):
            return True
    return False


def _near(
    points: Floats, triangles: NDArray[np.int32], low: ArrayLike, high: ArrayLike
) -> NDArray[np.int32]:
    """Return the triangles whose boxes meet the box from `low` to `high` [m]."""
    corners = points[triangles]
    meets = (corners.min(axis=1) <= high).all(axis=1) & (corners.max(axis=1) >= low).all(axis=1)
    return np.asarray(triangles[meets], dtype=np.int32)
