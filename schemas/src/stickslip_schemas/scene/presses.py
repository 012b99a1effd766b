"""Presses: bodies whose motions leave no room for the cloth between them and another body.

Such a scene costs minutes until the simulation gives up. Here the cloth between two bodies is
compared with how far they come together.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.box_trees import Workload
from stickslip_schemas.scene.geometry import TriangleMesh, ray_lengths
from stickslip_schemas.scene.mesh_bodies import MovingMesh
from stickslip_schemas.scene.motions import Track
from stickslip_schemas.scene.shapes import start_gap
from stickslip_schemas.scene.sheets import SheetStart
from stickslip_schemas.spec.jobs import StartFault

Floats = npt.NDArray[np.float64]

MAX_PUSH = 0.1
"""How far cloth is pushed until it meets the other body, over the size of the sheet.

Cloth that is pushed further may slide away before it is pressed."""

MAX_DIRECTIONS = 4
"""Directions in which the farthest position of a body is looked at."""

SAME_DIRECTION = 0.99
"""Cosine between two displacements from which they count as being in one direction."""

CLOSING_SAMPLES = 65
"""Instants at which the way of two bodies towards each other is sampled."""

MAX_ASIDE = 0.05
"""Distance from the straight way up to which it counts as straight, over its length."""

LEAST_DOWN = 0.8
"""Cosine of the angle between a press and gravity up to which free cloth stays on what it lies on.
"""

MIN_FRACTION = 0.02
"""Fraction of the vertices of a sheet that a press must hold: the rim may slip out of it."""

MAX_VERTICES = 1000
"""Vertices of a sheet that are compared with a press: evenly spread over all."""

FALL_STEPS = 64
"""Steps along the distance after which a grazing fall counts as a miss."""

FALL_TOLERANCE = 1e-6
"""Distance at which a fall has met a body [m]."""

FARTHEST_FALL = 100.0
"""Distance after which a fall counts as a miss [m]: the largest coordinate of a scene."""


def press_faults(
    document: Mapping[str, Any],
    sheets: list[SheetStart],
    meshes: Mapping[str, MovingMesh],
    end: float,
    workload: Workload,
) -> Iterator[StartFault]:
    """Yield the bodies that are pushed into another one through the cloth between them.

    Two bodies that both move, such as the jaws of a gripper, count as one that moves towards one
    that stays.

    Args:
        document: The physics as JSON, with the arrays of files.
        sheets: Where the sheets start.
        meshes: The bodies of type mesh.
        end: When the scene ends [s].
        workload: The comparisons of triangles that are allowed; TooManyPairsError ends it.
    """
    bodies = [
        _solid_of(name, body, meshes.get(name)) for name, body in sorted(document["bodies"].items())
    ]
    cloths = [_cloth_of(document, sheet) for sheet in sheets if not sheet.is_hung]
    for body in bodies:
        for other in bodies:
            # Of two bodies that move, the first one by name is the one to be named.
            if not body.is_moved or (other.is_moved and other.name <= body.name):
                continue
            fault = _press_fault(document, _Approach(body, other), cloths, end, workload)
            if fault is not None:
                yield fault
                break


def _press_fault(
    document: Mapping[str, Any],
    approach: "_Approach",
    cloths: "list[_Cloth]",
    end: float,
    workload: Workload,
) -> StartFault | None:
    """Return the fault of a body that comes too near to another one; None if it does not."""
    body = approach.body
    for time in approach.farthest_times(end):
        closing = approach.closing(time)
        if closing is None:
            continue
        gravity = np.array(document["gravity"], float)
        lying = [cloth for cloth in cloths if cloth.stays(gravity, closing.direction)]
        excess = closing.distances[-1] - _room(approach, closing, lying, workload)
        if excess <= 0.0:
            continue
        rule = (
            f"must leave room for the cloth between this body and {approach.other.name}, and at "
            f"{time:g} s it is {1e3 * excess:.3g} mm further than the cloth lets it; end the "
            "motion earlier by that and by the thickness of the cloth"
        )
        member = "file" if body.document.get("motion") is None else "motion"
        return StartFault(("bodies", body.name, member), rule, {"time": time})
    return None


@dataclass(frozen=True, eq=False, slots=True)
class _Solid:
    """A body, and how it moves as a whole."""

    name: str
    document: Mapping[str, Any]
    """Its JSON."""
    surface: TriangleMesh | None
    """The triangles of a mesh at the start."""
    displacement: Callable[[Floats], Floats] | None
    """Displacements since the start (T, 3) [m] at times (T,) [s]; None if it turns or deforms."""
    times: Floats
    """When the displacement may be farthest (K,) [s]."""
    is_moved: bool
    """True if it moves, or in an unknown way."""

    def falls(self, points: Floats, direction: Floats, workload: Workload) -> Floats:
        """Return how far points (N, 3) go along a direction until they meet the body [m].

        It is inf for points that never do.
        """
        if self.surface is not None:
            return ray_lengths(self.surface, points, direction, FARTHEST_FALL, workload)
        travelled = np.zeros(len(points))
        gaps = np.zeros(len(points))
        # Steps of the distance to the body never pass its surface.
        for _ in range(FALL_STEPS):
            gaps = np.maximum(
                start_gap(self.document, points + travelled[:, None] * direction), 0.0
            )
            travelled = np.minimum(travelled + gaps, FARTHEST_FALL)
        return np.where(gaps < FALL_TOLERANCE, travelled, np.inf)


def _solid_of(name: str, body: Mapping[str, Any], mesh: MovingMesh | None) -> _Solid:
    """Return a body of the document, and its motion; `mesh` is None of one without triangles."""
    surface = None
    moves, times = np.zeros((1, 3)), np.zeros(1)
    if mesh is not None:
        surface = mesh.surface
        moves, times = mesh.frames.rigid_displacements
    is_rigid = len(moves) > 0
    if body.get("motion") is None:
        by_frames = partial(_interpolated, times, moves) if is_rigid else None
        return _Solid(name, body, surface, by_frames, times, not is_rigid or bool(np.any(moves)))
    # Frames and a motion together have other times than either.
    track = Track(body["motion"])
    if not is_rigid or np.any(moves) or not track.is_translation:
        return _Solid(name, body, surface, None, np.empty(0), True)
    return _Solid(name, body, surface, track.displacements, track.end_times, track.moves)


def _interpolated(times: Floats, moves: Floats, instants: Floats) -> Floats:
    """Return displacements (T, 3) at instants (T,) between those at frames."""
    return np.stack([np.interp(instants, times, column) for column in moves.T], axis=1)


@dataclass(frozen=True, eq=False, slots=True)
class _Closing:
    """Two bodies that come straight towards each other."""

    direction: Floats
    """(3,): of the first body, as the other one sees it."""
    distances: Floats
    """How far they have come towards each other (T,) [m], ascending."""
    ways: Floats
    """The part of it that the first body has gone itself (T,) [m]."""


@dataclass(frozen=True, eq=False, slots=True)
class _Approach:
    """The motion of a body as another one sees it."""

    body: _Solid
    other: _Solid

    def farthest_times(self, end: float) -> list[float]:
        """Return when the body is farthest from its start, once for each direction [s]."""
        if self.body.displacement is None or self.other.displacement is None:
            return []
        times = np.unique(np.concatenate([self.body.times, self.other.times]))
        times = times[times <= end]
        moves = self.body.displacement(times) - self.other.displacement(times)
        lengths = np.linalg.norm(moves, axis=1)
        chosen: list[int] = []
        # A body that goes on in a direction has passed where it was before.
        for key in np.argsort(-lengths, kind="stable").tolist():
            if not lengths[key] or len(chosen) == MAX_DIRECTIONS:
                break
            cosines = [moves[key] @ moves[k] / (lengths[key] * lengths[k]) for k in chosen]
            if all(cosine < SAME_DIRECTION for cosine in cosines):
                chosen.append(key)
        return [float(times[key]) for key in chosen]

    def closing(self, time: float) -> _Closing | None:
        """Return the way to where they are at a time [s]; None if it is not straight."""
        assert self.body.displacement is not None
        assert self.other.displacement is not None
        instants = np.linspace(0.0, time, CLOSING_SAMPLES)
        of_body = self.body.displacement(instants)
        moves = of_body - self.other.displacement(instants)
        direction = moves[-1] / np.linalg.norm(moves[-1])
        # Of a pair that moves to the side, too, nobody knows which cloth stays between.
        aside = max(_aside(moves, direction), _aside(of_body, direction))
        if aside > MAX_ASIDE * float(np.linalg.norm(moves[-1])):
            return None
        distances = np.maximum.accumulate(moves @ direction)
        return _Closing(direction, distances, of_body @ direction)


def _aside(moves: Floats, direction: Floats) -> float:
    """Return the largest distance of displacements (T, 3) from a line [m]."""
    along = moves @ direction
    return float(np.linalg.norm(moves - along[:, None] * direction, axis=1).max())


@dataclass(frozen=True, eq=False, slots=True)
class _Cloth:
    """A sheet that presses are compared with."""

    points: Floats
    """Vertices of it at the start, evenly spread (N, 3) [m]."""
    size: float
    """The longer side of the flat sheet [m]."""
    is_moved: bool
    """True if a holder moves it."""
    is_held: bool
    """True if a holder always holds it."""

    def stays(self, gravity: Floats, direction: Floats) -> bool:
        """Return whether it is known where the sheet is when a press comes along a direction.

        It lies on what is below it, or a holder that stays holds it.
        """
        if self.is_moved:
            return False
        is_down = float(gravity @ direction) >= LEAST_DOWN * float(np.linalg.norm(gravity))
        return is_down or self.is_held


def _cloth_of(document: Mapping[str, Any], sheet: SheetStart) -> _Cloth:
    """Return what presses need of a sheet."""
    count = len(sheet.positions)
    chosen = np.unique(np.linspace(0, count - 1, min(count, MAX_VERTICES)).astype(np.int64))
    holders = document["sheets"][sheet.name]["holders"].values()
    return _Cloth(
        sheet.positions[chosen],
        float(np.ptp(sheet.rest, axis=0).max()),
        is_moved=any(holder["motion"] is not None for holder in holders),
        is_held=any(holder["grasp"] is None for holder in holders),
    )


def _room(
    approach: _Approach, closing: _Closing, cloths: list[_Cloth], workload: Workload
) -> float:
    """Return how far two bodies can come together until they hold cloth [m]; inf if never."""
    rooms = [np.inf]
    direction = closing.direction
    for cloth in cloths:
        # Each vertex is followed to the body ahead, and back to the one that comes.
        to_other = approach.other.falls(cloth.points, direction, workload)
        is_between = np.isfinite(to_other)
        if not is_between.any():
            continue
        to_body = np.full(len(cloth.points), np.inf)
        to_body[is_between] = approach.body.falls(cloth.points[is_between], -direction, workload)
        room = to_other + to_body
        # The one that reaches the cloth first pushes it until the other one is there.
        pushed = np.abs(np.interp(room, closing.distances, closing.ways) - to_body)
        stays = pushed <= MAX_PUSH * cloth.size
        distances = np.sort(np.where(stays & np.isfinite(room), room, np.inf))
        rooms.append(float(distances[int(MIN_FRACTION * len(distances))]))
    return min(rooms)
