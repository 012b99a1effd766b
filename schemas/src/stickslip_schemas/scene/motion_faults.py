"""Motions that no sample survives: too fast for the solver, or tearing the cloth."""

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.mesh_bodies import MovingMesh
from stickslip_schemas.scene.motions import SHORTEST_STEPS, Track
from stickslip_schemas.scene.parameters import Location
from stickslip_schemas.scene.sheets import SheetStart, held_vertices
from stickslip_schemas.spec.jobs import StartFault

Floats = npt.NDArray[np.float64]

MAX_UNEVENNESS = 4.0
"""Distance from an even motion within the shortest step, over the step error of the preset.

The solver rejects a run from 1 on. It may halve a step twice more where that step does not
converge, so only from 4 on is the end certain."""

MAX_STRETCH = 1.25
"""Largest stretch of a triangle in a valid run: the solver's check `stretch`."""

COMPARED_INSTANTS = 4_000
"""Instants at which pairs of holders are compared, all together: about 0.2 s of CPU time."""

LEAST_INSTANTS = 16
"""Instants at which each pair is compared."""

COMPARED_VERTICES = 12
"""Vertices of each of two holders whose distances are compared."""


def motion_faults(
    document: Mapping[str, Any],
    sheets: list[SheetStart],
    meshes: Mapping[str, MovingMesh],
    end: float,
) -> Iterator[StartFault]:
    """Yield holders and bodies that move too fast for the shortest steps of the preset.

    Args:
        document: The physics as JSON, with the arrays of files.
        sheets: Where the sheets start.
        meshes: The bodies of type mesh.
        end: When the scene ends [s].
    """
    shortest, error = SHORTEST_STEPS[document["preset"]]
    limit = (
        f"steps of {shortest:g} s follow to {error:g} m, as the preset {document['preset']} asks"
    )
    for path, motion, radius in _rigid_motions(document, sheets, meshes):
        time, unevenness = Track(motion).unevenness(shortest, radius, end)
        if unevenness > MAX_UNEVENNESS * error:
            rule = (
                f"must be one that {limit}, and at {time:g} s it is {unevenness:.2g} m off an even "
                "motion; give it more time, or a ramp (turns are in radians)"
            )
            yield StartFault(path, rule, {"time": time})
    for name, mesh in meshes.items():
        jump = mesh.frames.largest_jump(shortest, end)
        if jump is not None and jump.distance > MAX_UNEVENNESS * error:
            rule = (
                f"must have frames that {limit}, and at {jump.time:g} s vertex {jump.vertex} is "
                f"{jump.distance:.2g} m off an even motion, at a speed of {jump.speed:.3g} m/s; "
                "give it more time, with more frames or a lower frame_rate"
            )
            yield StartFault(("bodies", name, "file"), rule, {"time": jump.time})


def _rigid_motions(
    document: Mapping[str, Any], sheets: list[SheetStart], meshes: Mapping[str, MovingMesh]
) -> Iterator[tuple[Location, Any, float]]:
    """Yield the motions of a document: location, motion, and radius of what turns [m]."""
    for sheet in sheets:
        holders = document["sheets"][sheet.name]["holders"]
        for key, holder in sorted(holders.items()):
            if holder["motion"] is not None:
                points = sheet.positions[held_vertices(sheet, holder)]
                location: Location = ("sheets", sheet.name, "holders", key, "motion")
                yield location, holder["motion"], _radius(points)
    for name, body in sorted(document["bodies"].items()):
        # A plane does not move, and other bodies count where they are near the cloth, of which
        # only a mesh counts as a whole.
        if body.get("motion") is not None:
            radius = _radius(meshes[name].surface.vertices) if name in meshes else 0.0
            yield ("bodies", name, "motion"), body["motion"], radius


def _radius(points: Floats) -> float:
    """Return the distance of the farthest of points (K, 3) from their middle [m]."""
    if not len(points):
        return 0.0
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def stretch_faults(
    document: Mapping[str, Any], sheets: list[SheetStart], end: float
) -> Iterator[StartFault]:
    """Yield holders that pull two vertices further apart than the cloth between them reaches.

    Args:
        document: The physics as JSON, with the arrays of files.
        sheets: Where the sheets start.
        end: When the scene ends [s].
    """
    pairs = []
    for sheet in sheets:
        holders = document["sheets"][sheet.name]["holders"]
        always = [key for key, holder in sorted(holders.items()) if holder["grasp"] is None]
        pairs += [(sheet, key, other) for key, other in combinations(always, 2)]
    if not pairs:
        return
    instants = max(LEAST_INSTANTS, COMPARED_INSTANTS // len(pairs))
    for sheet, key, other in pairs:
        holders = document["sheets"][sheet.name]["holders"]
        time, stretch = _largest_stretch(sheet, holders[key], holders[other], end, instants)
        if stretch <= MAX_STRETCH:
            continue
        rule = (
            f"must not stretch the cloth between it and the holder {key} to more than "
            f"{MAX_STRETCH:g} times its length, and at {time:g} s it is {stretch:.3g} times as "
            "long; bring the two nearer to each other, or let one go with grasp"
        )
        yield StartFault(("sheets", sheet.name, "holders", other, "motion"), rule, {"time": time})


def _largest_stretch(
    sheet: SheetStart,
    first: Mapping[str, Any],
    second: Mapping[str, Any],
    end: float,
    instants: int,
) -> tuple[float, float]:
    """Return when two holders stretch the cloth between them most [s], and the stretch there.

    It is a lower bound: the cloth between two vertices is no shorter than the distance of both, and
    of more keys than `instants` only some are compared.
    """
    held = [
        _evenly_spread(np.flatnonzero(held_vertices(sheet, holder))) for holder in (first, second)
    ]
    tracks = [None if h["motion"] is None else Track(h["motion"]) for h in (first, second)]
    keys = [track.times[track.times <= end] for track in tracks if track is not None]
    if sheet.jitter or not len(held[0]) or not len(held[1]) or not keys:
        return 0.0, 0.0
    times = np.unique(np.concatenate(keys))
    times = times[np.unique(np.linspace(0, len(times) - 1, instants).astype(np.int64))]
    # The flat sheet is the longest that the cloth between two vertices can be without a stretch.
    lengths = np.linalg.norm(sheet.rest[held[0]][:, None] - sheet.rest[held[1]][None], axis=2)
    points = []
    for vertices, track, holder in zip(held, tracks, (first, second), strict=True):
        at_start = sheet.positions[vertices]
        middle = sheet.positions[held_vertices(sheet, holder)].mean(axis=0)
        still = np.broadcast_to(at_start, (len(times), *at_start.shape))
        points.append(still if track is None else track.moved(at_start, middle, times))
    distances = np.linalg.norm(points[0][:, :, None] - points[1][:, None], axis=3)
    stretches = (distances / np.maximum(lengths, 1e-300)).max(axis=(1, 2))
    if not len(stretches):
        return 0.0, 0.0
    largest = int(np.argmax(stretches))
    return float(times[largest]), float(stretches[largest])


def _evenly_spread(vertices: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return at most `COMPARED_VERTICES` of the vertices, evenly spread."""
    count = min(len(vertices), COMPARED_VERTICES)
    if not count:
        return vertices
    return vertices[np.linspace(0, len(vertices) - 1, count).astype(np.int64)]
