"""Presses: bodies whose keyframes leave no room for the cloth between them and another body.

Such a scene costs minutes until the simulation gives up. Here the cloth that lies on a body is
compared with how far another one comes down on it.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.motions import Track
from stickslip_schemas.scene.shapes import start_gap
from stickslip_schemas.scene.sheets import SheetStart
from stickslip_schemas.spec.jobs import StartFault

Floats = npt.NDArray[np.float64]

MAX_HEIGHT = 0.1
"""Height over a body, over the size of the sheet, up to which cloth counts as lying on it.

Cloth further up may slide away before the press comes down."""

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
    solid = {name: body for name, body in document["bodies"].items() if body["type"] != "mesh"}
    lying = [sheet for sheet in sheets if _may_lie(document, sheet)]
    for name, body in sorted(solid.items()):
        if body["type"] == "plane" or body["motion"] is None:
            continue
        moves, times = Track(body["motion"]).displacements()
        lengths = np.where(times <= end, np.linalg.norm(moves, axis=1), 0.0)
        if not len(lengths) or not lengths.any():
            continue
        # The farthest key decides: a body that goes on later has passed there.
        key = int(np.argmax(lengths))
        direction = moves[key] / lengths[key]
        resting = {
            other: solid[other]
            for other in sorted(solid)
            if other != name and solid[other].get("motion") is None
        }
        for other, table in resting.items():
            excess = lengths[key] - _room(body, table, direction, lying)
            if excess <= 0.0:
                continue
            rule = (
                f"must leave room for the cloth between this body and {other}, and at "
                f"{times[key]:g} s it is {1e3 * excess:.3g} mm further than the cloth lets it; end "
                "the motion earlier by that and by the thickness of the cloth"
            )
            yield StartFault(("bodies", name, "motion"), rule, {"time": float(times[key])})
            break


def _may_lie(document: Mapping[str, Any], sheet: SheetStart) -> bool:
    """Return whether it is known where a sheet is when a press comes down."""
    holders = document["sheets"][sheet.name]["holders"].values()
    is_pulled = any(holder["motion"] is not None for holder in holders)
    return not (sheet.is_hung or is_pulled)


def _room(
    body: Mapping[str, Any], table: Mapping[str, Any], direction: Floats, sheets: list[SheetStart]
) -> float:
    """Return how far a body can move until it holds cloth against a table [m]; inf if never."""
    rooms = [np.inf]
    for sheet in sheets:
        count = len(sheet.positions)
        chosen = np.unique(np.linspace(0, count - 1, min(count, MAX_VERTICES)).astype(np.int64))
        points = sheet.positions[chosen]
        # Each vertex is followed to the table ahead of the body, and back to the body.
        to_table = _falls(table, points, direction)
        to_body = _falls(body, points, -direction)
        lies = to_table <= MAX_HEIGHT * float(np.ptp(sheet.rest, axis=0).max())
        distances = np.sort(np.where(lies, to_table + to_body, np.inf))
        rooms.append(float(distances[int(MIN_FRACTION * len(distances))]))
    return min(rooms)


def _falls(body: Mapping[str, Any], points: Floats, direction: Floats) -> Floats:
    """Return how far points (N, 3) go along a direction until they meet a body [m]; inf: never."""
    travelled = np.zeros(len(points))
    gaps = np.zeros(len(points))
    # Steps of the distance to the body never pass its surface.
    for _ in range(FALL_STEPS):
        gaps = np.maximum(start_gap(body, points + travelled[:, None] * direction), 0.0)
        travelled = np.minimum(travelled + gaps, FARTHEST_FALL)
    return np.where(gaps < FALL_TOLERANCE, travelled, np.inf)
