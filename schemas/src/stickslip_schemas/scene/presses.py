"""Presses: bodies whose motions leave no room for the cloth between them and another body.

Such a scene costs minutes until the simulation gives up. Here the cloth that lies on a body is
compared with how far another one comes down on it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.geometry import TriangleMesh, ray_lengths
from stickslip_schemas.scene.mesh_bodies import rigid_displacements, surface_at_start
from stickslip_schemas.scene.motions import Track
from stickslip_schemas.scene.shapes import start_gap
from stickslip_schemas.scene.sheets import SheetStart
from stickslip_schemas.spec.jobs import StartFault

Floats = npt.NDArray[np.float64]

MAX_HEIGHT = 0.1
"""Height over a body, over the size of the sheet, up to which cloth counts as lying on it.

Cloth further up may slide away before the press comes down."""

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
    document: Mapping[str, Any], sheets: list[SheetStart], end: float
) -> Iterator[StartFault]:
    """Yield the bodies that are pushed into another one through the cloth between them.

    Args:
        document: The physics as JSON, with the arrays of files.
        sheets: Where the sheets start.
        end: When the scene ends [s].
    """
    surfaces = {
        name: surface_at_start(body)
        for name, body in document["bodies"].items()
        if body["type"] == "mesh"
    }
    bodies = {
        name: _Solid(body, surfaces.get(name), *_displacements(body))
        for name, body in sorted(document["bodies"].items())
    }
    for name, body in bodies.items():
        lengths = np.where(body.times <= end, np.linalg.norm(body.moves, axis=1), 0.0)
        if not len(lengths) or not lengths.any():
            continue
        # The farthest key decides: a body that goes on later has passed there.
        key = int(np.argmax(lengths))
        direction = body.moves[key] / lengths[key]
        lying = [sheet for sheet in sheets if _stays(document, sheet, direction)]
        for other, table in bodies.items():
            if other == name or table.is_moved:
                continue
            excess = lengths[key] - _room(body, table, direction, lying)
            if excess <= 0.0:
                continue
            rule = (
                f"must leave room for the cloth between this body and {other}, and at "
                f"{body.times[key]:g} s it is {1e3 * excess:.3g} mm further than the cloth lets "
                "it; end the motion earlier by that and by the thickness of the cloth"
            )
            member = "file" if body.document.get("motion") is None else "motion"
            value = {"time": float(body.times[key])}
            yield StartFault(("bodies", name, member), rule, value)
            break


@dataclass(frozen=True, eq=False, slots=True)
class _Solid:
    """A body, and how it moves as a whole."""

    document: Mapping[str, Any]
    """Its JSON."""
    surface: TriangleMesh | None
    """The triangles of a mesh at the start."""
    moves: Floats
    """Displacements since the start (K, 3) [m]; empty if it turns or deforms."""
    times: Floats
    """(K,) [s]"""

    @property
    def is_moved(self) -> bool:
        """Whether it moves, or in an unknown way."""
        return not len(self.moves) or bool(np.any(self.moves))

    def falls(self, points: Floats, direction: Floats) -> Floats:
        """Return how far points (N, 3) go along a direction until they meet the body [m].

        It is inf for points that never do.
        """
        if self.surface is not None:
            return ray_lengths(self.surface, points, direction, FARTHEST_FALL)
        travelled = np.zeros(len(points))
        gaps = np.zeros(len(points))
        # Steps of the distance to the body never pass its surface.
        for _ in range(FALL_STEPS):
            gaps = np.maximum(
                start_gap(self.document, points + travelled[:, None] * direction), 0.0
            )
            travelled = np.minimum(travelled + gaps, FARTHEST_FALL)
        return np.where(gaps < FALL_TOLERANCE, travelled, np.inf)


def _displacements(body: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return the displacements of a body (K, 3) [m] at times (K,) [s]; empty if it turns."""
    by_frames = (np.zeros((1, 3)), np.zeros(1))
    if body["type"] == "mesh":
        by_frames = rigid_displacements(body)
    if body.get("motion") is None:
        return by_frames
    # Frames and a motion together have other times than either.
    is_still = len(by_frames[0]) > 0 and not np.any(by_frames[0])
    return Track(body["motion"]).displacements() if is_still else (np.empty((0, 3)), np.empty(0))


def _stays(document: Mapping[str, Any], sheet: SheetStart, direction: Floats) -> bool:
    """Return whether it is known where a sheet is when a press comes along a direction.

    It lies on what is below it, or a holder that stays holds it.
    """
    holders = document["sheets"][sheet.name]["holders"].values()
    if sheet.is_hung or any(holder["motion"] is not None for holder in holders):
        return False
    gravity = np.array(document["gravity"], float)
    is_down = float(gravity @ direction) >= LEAST_DOWN * float(np.linalg.norm(gravity))
    return is_down or any(holder["grasp"] is None for holder in holders)


def _room(body: _Solid, table: _Solid, direction: Floats, sheets: list[SheetStart]) -> float:
    """Return how far a body can move until it holds cloth against a table [m]; inf if never."""
    rooms = [np.inf]
    for sheet in sheets:
        count = len(sheet.positions)
        chosen = np.unique(np.linspace(0, count - 1, min(count, MAX_VERTICES)).astype(np.int64))
        points = sheet.positions[chosen]
        # Each vertex is followed to the table ahead of the body, and back to the body.
        to_table = table.falls(points, direction)
        to_body = body.falls(points, -direction)
        lies = to_table <= MAX_HEIGHT * float(np.ptp(sheet.rest, axis=0).max())
        distances = np.sort(np.where(lies, to_table + to_body, np.inf))
        rooms.append(float(distances[int(MIN_FRACTION * len(distances))]))
    return min(rooms)
