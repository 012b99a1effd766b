"""Sizes of a scene as a whole: of all its files together, and of the gaps between its things.

A file has limits of its own (`gate`). One file may serve many bodies or holders, each of which
costs time and memory.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from stickslip_schemas.scene.gate import MAX_PATH_ROWS, MAX_TRIANGLES
from stickslip_schemas.scene.mesh_bodies import MovingMesh
from stickslip_schemas.scene.parameters import Location
from stickslip_schemas.scene.parts import LARGEST, unit_hint
from stickslip_schemas.scene.shapes import start_gap
from stickslip_schemas.scene.sheets import Floats, SheetStart
from stickslip_schemas.spec.jobs import StartFault

MAX_BODY_TRIANGLES = 2 * MAX_TRIANGLES
"""Triangles of all bodies together: a second of CPU time for each check of a start."""

MAX_MOTION_ROWS = 2 * MAX_PATH_ROWS
"""Rows of the paths of all bodies and holders together."""

MAX_GAP = LARGEST
"""Gap between a sheet and the nearest thing from which another unit is likely [m]."""

MAX_GAP_RATIO = 20.0
"""The same gap over the size of the sheet."""


def size_faults(document: Mapping[str, Any]) -> Iterator[StartFault]:
    """Yield that the bodies or the motions of a scene are too much together.

    `document` is the physics as JSON, with the arrays of files.
    """
    bodies: Mapping[str, Any] = document["bodies"]
    triangles = {
        name: len(body["file"]["triangles"])
        for name, body in sorted(bodies.items())
        if body["type"] == "mesh"
    }
    if sum(triangles.values()) > MAX_BODY_TRIANGLES:
        rule = (
            f"must have at most {MAX_BODY_TRIANGLES} triangles together: make meshes coarser (in "
            "Blender: Decimate), or leave out bodies that no cloth reaches"
        )
        yield StartFault(("bodies",), rule, sum(triangles.values()))
    rows = {location: len(motion["path"]["time"]) for location, motion in _paths(document)}
    if sum(rows.values()) > MAX_MOTION_ROWS:
        rule = (
            f"must have paths of at most {MAX_MOTION_ROWS} rows together, each time that one is "
            f"named, and has {sum(rows.values())}: leave out rows that lie on the way between "
            "their neighbours"
        )
        longest = max(rows, key=lambda location: rows[location])
        yield StartFault(longest, rule, rows[longest])


def _paths(document: Mapping[str, Any]) -> Iterator[tuple[Location, Mapping[str, Any]]]:
    """Yield the motions along paths of files, with their locations."""
    motions: list[tuple[Location, Any]] = [
        (("bodies", name, "motion"), body.get("motion"))
        for name, body in sorted(document["bodies"].items())
    ]
    for name, sheet in sorted(document["sheets"].items()):
        for key, holder in sorted(sheet["holders"].items()):
            motions.append((("sheets", name, "holders", key, "motion"), holder["motion"]))
    for location, motion in motions:
        if motion is not None and motion["path"] is not None:
            yield (*location, "path"), motion


def gap_faults(
    document: Mapping[str, Any], sheets: list[SheetStart], meshes: Mapping[str, MovingMesh]
) -> Iterator[StartFault]:
    """Yield sheets that start very far from all that they could touch, as with mixed units.

    Args:
        document: The physics as JSON, with the arrays of files, and with the roundings of boxes.
        sheets: Where the sheets start.
        meshes: The bodies of type mesh.
    """
    holders = {sheet.name: document["sheets"][sheet.name]["holders"].values() for sheet in sheets}
    motions = [holder["motion"] for of_sheet in holders.values() for holder in of_sheet]
    motions += [body.get("motion") for body in document["bodies"].values()]
    # What moves may come from anywhere.
    if not document["bodies"] or any(motions):
        return
    for sheet in sheets:
        size = float(np.ptp(sheet.rest, axis=0).max())
        solids = [body for name, body in document["bodies"].items() if name not in meshes]
        gaps = [float(start_gap(body, sheet.positions).min()) for body in solids]
        # The box around a mesh tells enough.
        gaps += [_box_gap(sheet, mesh.surface.vertices) for mesh in meshes.values()]
        gaps += [_box_gap(sheet, other.positions) for other in sheets if other is not sheet]
        gap = min(gaps)
        if gap <= max(MAX_GAP, MAX_GAP_RATIO * size):
            continue
        rule = (
            f"must be near something that the sheet can touch, and the nearest thing is {gap:.4g} "
            f"m away, {gap / size:.3g} times the size of the sheet{unit_hint(gap)}"
        )
        origin = document["sheets"][sheet.name]["origin"]
        yield StartFault(("sheets", sheet.name, "origin"), rule, origin)


def _box_gap(sheet: SheetStart, points: Floats) -> float:
    """Return the distance between the boxes around a sheet and points (N, 3) [m]."""
    positions = sheet.positions
    below = positions.min(axis=0) - points.max(axis=0)
    above = points.min(axis=0) - positions.max(axis=0)
    return float(np.linalg.norm(np.maximum(np.maximum(below, above), 0.0)))
