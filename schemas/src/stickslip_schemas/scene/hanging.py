"""Where hung sheets hang, as far as geometry alone tells.

A sheet whose holders take a level line across its whole width, at one side of it, hangs straight
down from there, along gravity: no vertex can hang lower. Sheets that hang from corners or from
strips are left to the simulation.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.sheets import SheetStart, held_vertices

Floats = npt.NDArray[np.float64]

STRAIGHT = 1e-6
"""Distance of held vertices from a line, over the size of the sheet, up to which they form one."""

LEVEL = 1e-3
"""Slope up to which a line counts as level."""

UNCERTAIN_SHARE = 0.02
"""How far the vertices of a hung sheet may be from where they are expected, over its size.

Gravity stretches a sheet by less, and its bias tilts it by up to 0.003."""

UNCERTAIN_DISTANCE = 2e-3
"""The same for small sheets, whose bending counts [m]."""


def hung_positions(document: Mapping[str, Any], sheet: SheetStart) -> Floats | None:
    """Return where the vertices of a hung sheet are (V, 3) [m]; None if geometry does not tell.

    `document` is the physics as JSON, with the arrays of files.
    """
    gravity = np.array(document["gravity"], float)
    down = gravity / np.linalg.norm(gravity)
    held = np.zeros(len(sheet.rest), dtype=bool)
    for holder in document["sheets"][sheet.name]["holders"].values():
        held |= held_vertices(sheet, holder)
    numbers = np.flatnonzero(held)
    if len(numbers) < 2:
        return None
    size = float(np.ptp(sheet.rest, axis=0).max())
    # The line runs between the two held vertices that are farthest from each other.
    first = numbers[0]
    last = numbers[np.argmax(np.linalg.norm(sheet.rest[numbers] - sheet.rest[first], axis=1))]
    length = float(np.linalg.norm(sheet.rest[last] - sheet.rest[first]))
    along = (sheet.rest[last] - sheet.rest[first]) / length
    offsets = sheet.rest - sheet.rest[first]
    places = offsets @ along
    heights = offsets @ np.array([-along[1], along[0]])
    direction = (sheet.positions[last] - sheet.positions[first]) / length
    is_line = np.abs(heights[held]).max() <= STRAIGHT * size
    is_level = abs(direction @ down) <= LEVEL
    is_at_one_side = min(heights.max(), -heights.min()) <= STRAIGHT * size
    is_across = np.ptp(places[held]) >= (1.0 - UNCERTAIN_SHARE) * np.ptp(places)
    if not (is_line and is_level and is_at_one_side and is_across):
        return None
    below = np.abs(heights)[:, None] * down
    return np.asarray(sheet.positions[first] + places[:, None] * direction + below)


def uncertainty(sheet: SheetStart) -> float:
    """Return how far the vertices of a hung sheet may be from `hung_positions` [m]."""
    size = float(np.ptp(sheet.rest, axis=0).max())
    return max(UNCERTAIN_DISTANCE, UNCERTAIN_SHARE * size) + sheet.jitter
