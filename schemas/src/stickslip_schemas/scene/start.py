"""Whether a scene can start: what the simulation would refuse, or could never bring to an end.

The rules are those of the simulation core, found here by geometry alone, so that a coordinator
without the core refuses a scene before anything is queued:

    sheets      together within the size that the solver takes, thinner than their cells, each in
                one piece
    holders     hold a vertex each, none twice, and leave one free
    start       no sheet inside a body, across another thing, or at no distance from it
    motions     no faster than the shortest steps of the preset can follow
    holders     do not tear the cloth between them
    presses     leave room for the cloth between two bodies (`presses`)
"""

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.errors import UnfitStartError
from stickslip_schemas.scene.geometry import (
    TriangleMesh,
    find_crossing,
    find_self_crossing,
    find_touch,
)
from stickslip_schemas.scene.motions import SHORTEST_STEPS, Track
from stickslip_schemas.scene.parameters import Location
from stickslip_schemas.scene.presses import press_faults
from stickslip_schemas.scene.shapes import start_gap
from stickslip_schemas.scene.sheets import SheetStart, held_vertices, start_of
from stickslip_schemas.spec.jobs import StartFault

Floats = npt.NDArray[np.float64]

MAX_EXTENT = 20.0
"""Largest length and width of all sheets, side by side [m]: `EXTENT_MAX` of the solver."""

MAX_DEPTH = 1e-6
"""Depth of a free vertex in a body from which the solver refuses a start [m]."""

LEAST_DISTANCE = 1e-7
"""Distance from which two things have a direction that parts them [m].

At 1 um the solver starts and pushes them apart. At 0 it has no direction, and never ends.
"""

MAX_UNEVENNESS = 4.0
"""Distance from an even motion within the shortest step, over the step error of the preset.

The solver rejects a run from 1 on. It may halve a step twice more where that step does not
converge, so only from 4 on is the end certain."""


MAX_STRETCH = 1.25
"""Largest stretch of a triangle in a valid run: the solver's check `stretch`."""

COMPARED_VERTICES = 12
"""Vertices of each of two holders whose distances are compared."""


def check_start(document: Mapping[str, Any]) -> None:
    """Raise UnfitStartError if a scene can never work.

    `document` is the physics as JSON, with the arrays of files (`files.with_arrays`).
    """
    faults = find_start_faults(document)
    if faults:
        lines = (f"{'.'.join(map(str, fault.location))}: {fault.rule}" for fault in faults)
        raise UnfitStartError("; ".join(lines))


def find_start_faults(document: Mapping[str, Any]) -> list[StartFault]:
    """Return why a scene can never work, at most one fault for each sheet, holder and body.

    `document` is the physics as JSON, with the arrays of files (`files.with_arrays`).
    """
    sheets = [start_of(name, sheet) for name, sheet in sorted(document["sheets"].items())]
    faults = list(_sheet_faults(document, sheets))
    faults += _holder_faults(document, sheets)
    faults += _motion_faults(document, sheets)
    # Geometry of a wrong unit or shape would only repeat these faults in many other words.
    if not faults:
        faults += _body_faults(document, sheets)
    if not faults:
        faults += _contact_faults(document, sheets)
    if not faults:
        faults += _stretch_faults(document, sheets)
    if not faults:
        faults += press_faults(document, sheets, document_end(document))
    return faults


# ---- Sheets by themselves


def _sheet_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    for sheet in sheets:
        given = document["sheets"][sheet.name]
        member = "file" if given["mesh"]["type"] == "file" else "size"
        location = ("sheets", sheet.name, "mesh", member)
        if sheet.pieces > 1:
            rule = (
                "must have triangles that hang together in 1 piece: weld vertices at equal "
                "positions, or make a sheet of each piece"
            )
            yield StartFault(location, rule, sheet.pieces)
        # A sheet that passes through itself is nowhere too near to itself.
        if given["self_contact"] and sheet.least_height <= given["thickness"]:
            rule = (
                f"must have triangles that are higher than the sheet is thick, which is "
                f"{given['thickness']:g} m: give lengths in metres, fewer cells, or a smaller "
                "thickness"
            )
            yield StartFault(location, rule, sheet.least_height)
    total = sum(float(np.ptp(sheet.rest[:, 0])) for sheet in sheets)
    if len(sheets) > 1 and total > MAX_EXTENT:
        rule = (
            f"must be at most {MAX_EXTENT:g} m wide together, side by side: make them smaller, or "
            "a scene of each"
        )
        yield StartFault(("sheets",), rule, total)


# ---- Holders


def _holder_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    for sheet in sheets:
        taken = np.zeros(len(sheet.rest), dtype=bool)
        holders = document["sheets"][sheet.name]["holders"]
        for key, holder in sorted(holders.items()):
            location: Location = ("sheets", sheet.name, "holders", key)
            held = held_vertices(sheet, holder, margin=-sheet.jitter)
            if not held_vertices(sheet, holder, margin=sheet.jitter).any():
                yield StartFault(location, _beside(sheet, holder), _area_of(holder))
            elif (held & taken).any():
                vertex = int(np.argmax(held & taken))
                rule = f"must not hold vertex {vertex}, which another holder holds; move it aside"
                yield StartFault(location, rule, _area_of(holder))
            taken |= held
        # What is let go becomes free, so only holders that always hold leave nothing to simulate.
        always = all(holder["grasp"] is None for holder in holders.values())
        if taken.all() and always and len(sheets) == 1:
            rule = "must leave a vertex free, and all are held; hold a smaller area"
            yield StartFault(("sheets", sheet.name, "holders"), rule, sorted(holders))


def _beside(sheet: SheetStart, holder: Mapping[str, Any]) -> str:
    """Return the rule that a holder breaks which holds no vertex."""
    if holder["vertices"] is not None:
        return f"must hold vertices below {len(sheet.rest)}, the number of vertices of the sheet"
    low = ", ".join(f"{value:g}" for value in sheet.rest.min(axis=0))
    high = ", ".join(f"{value:g}" for value in sheet.rest.max(axis=0))
    return (
        f"must hold a vertex, and no vertex is within low and high; the flat sheet goes from "
        f"({low}) to ({high}) m, measured from its middle: enlarge or move the area"
    )


def _area_of(holder: Mapping[str, Any]) -> Any:
    chosen = ("low", "high", "edge", "rim", "vertices")
    return {name: holder[name] for name in chosen if holder[name] is not None}


# ---- Motions


def _motion_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    shortest, error = SHORTEST_STEPS[document["preset"]]
    motions: list[tuple[Location, Any, float]] = []
    for sheet in sheets:
        holders = document["sheets"][sheet.name]["holders"]
        for key, holder in sorted(holders.items()):
            points = sheet.positions[held_vertices(sheet, holder)]
            location: Location = ("sheets", sheet.name, "holders", key, "motion")
            motions.append((location, holder["motion"], _radius(points)))
    for name, body in sorted(document["bodies"].items()):
        # A plane does not move. How far a body reaches does not matter to how fast it travels.
        motions.append((("bodies", name, "motion"), body.get("motion"), 0.0))
    for path, motion, radius in motions:
        if motion is None:
            continue
        track = Track(motion)
        time, unevenness = track.unevenness(shortest, radius)
        if time > document_end(document) or unevenness <= MAX_UNEVENNESS * error:
            continue
        rule = (
            f"must be one that steps of {shortest:g} s follow to {error:g} m, as the preset "
            f"{document['preset']} asks, and at {time:g} s it is {unevenness:.2g} m off an even "
            "motion; give it more time, or a ramp"
        )
        yield StartFault(path, rule, {"time": time})


def _radius(points: Floats) -> float:
    """Return the distance of the farthest of points (K, 3) from their middle [m]."""
    if not len(points):
        return 0.0
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def document_end(document: Mapping[str, Any]) -> float:
    """Return the time at which a scene ends at the latest [s]."""
    end = document["end"]
    return float(document["duration"] if end is None else end["at_most"])


# ---- Starts in and across others


def _body_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    """Yield sheets with a free vertex inside a body that has an inside."""
    for sheet in sheets:
        if sheet.is_hung:
            continue
        free = ~_held_at_start(document, sheet)
        for name, body in sorted(document["bodies"].items()):
            if body["type"] == "mesh":
                continue
            depth = np.where(free, -start_gap(body, sheet.positions), -np.inf)
            vertex = int(np.argmax(depth))
            if depth[vertex] <= max(MAX_DEPTH, sheet.jitter):
                continue
            rule = (
                f"must start outside of all bodies, and vertex {vertex} of the sheet is "
                f"{1e3 * depth[vertex]:.3g} mm inside {name}, near {_point(sheet, vertex)}; move "
                "the sheet or the body by more than that"
            )
            yield StartFault(("sheets", sheet.name, "origin"), rule, _origin(document, sheet))
            break


def _held_at_start(document: Mapping[str, Any], sheet: SheetStart) -> npt.NDArray[np.bool_]:
    held = np.zeros(len(sheet.rest), dtype=bool)
    for holder in document["sheets"][sheet.name]["holders"].values():
        if holder["grasp"] is None or holder["grasp"][0] == 0.0:
            held |= held_vertices(sheet, holder)
    return held


def _contact_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    """Yield sheets that cross themselves, other sheets or triangles of bodies, or lie in them."""
    standing = [sheet for sheet in sheets if not sheet.is_hung]
    surfaces = [
        (name, _surface_at_start(body))
        for name, body in sorted(document["bodies"].items())
        if body["type"] == "mesh"
    ]
    for number, sheet in enumerate(standing):
        self_contact = document["sheets"][sheet.name]["self_contact"]
        # A flat sheet cannot cross itself.
        if self_contact and not sheet.is_flat:
            crossing = find_self_crossing(sheet.mesh)
            if crossing is not None:
                rule = (
                    f"must not cross itself, and triangle {crossing.first} crosses triangle "
                    f"{crossing.second}, near {_coordinates(crossing.point)}; start it unfolded, "
                    "or set self_contact to false"
                )
                location = ("sheets", sheet.name, "start")
                yield StartFault(location, rule, document["sheets"][sheet.name]["start"]["type"])
        others = [(f"sheet {other.name}", other.mesh) for other in standing[:number]]
        others += [(f"body {name}", mesh) for name, mesh in surfaces]
        for name, mesh in others:
            rule = _meeting(sheet, name, mesh)
            if rule:
                location = ("sheets", sheet.name, "origin")
                yield StartFault(location, rule, _origin(document, sheet))
                break


def _meeting(sheet: SheetStart, name: str, mesh: TriangleMesh) -> str:
    """Return the rule that a sheet breaks with another thing; an empty text if it breaks none."""
    crossing = find_crossing(sheet.mesh, mesh)
    if crossing is not None:
        return (
            f"must not cross {name} at the start, and triangle {crossing.first} of the sheet "
            f"crosses triangle {crossing.second} of it, near {_coordinates(crossing.point)}; move "
            "them apart"
        )
    remedy = "leave half of both thicknesses between them"
    touch = find_touch(sheet.mesh.vertices, mesh, LEAST_DISTANCE)
    if touch is not None:
        return (
            f"must not lie in {name} at the start, and vertex {touch.vertex} of the sheet is at "
            f"{touch.distance:.2g} m from triangle {touch.triangle} of it, near "
            f"{_point(sheet, touch.vertex)}; {remedy}"
        )
    # Where the other thing is the smaller one, its vertices lie in the sheet.
    touch = find_touch(mesh.vertices, sheet.mesh, LEAST_DISTANCE)
    if touch is not None:
        point = _coordinates(mesh.vertices[touch.vertex].tolist())
        return (
            f"must not lie in {name} at the start, and triangle {touch.triangle} of the sheet is "
            f"at {touch.distance:.2g} m from vertex {touch.vertex} of it, near {point}; {remedy}"
        )
    return ""


def _surface_at_start(body: Mapping[str, Any]) -> TriangleMesh:
    """Return the triangles of a body where they are at 0 s."""
    file = body["file"]
    if "bones" in file:
        homogeneous = np.column_stack([file["rest"], np.ones(len(file["rest"]))])
        by_bone = np.einsum("bij,nj->nbi", file["bones"][0], homogeneous)
        vertices = np.einsum("nb,nbi->ni", file["weights"], by_bone)
    else:
        vertices = np.asarray(file["positions"][0], float)
    if body["motion"] is not None:
        pose = Track(body["motion"]).pose_at_start(vertices.mean(axis=0))
        vertices = vertices @ pose[:, :3].T + pose[:, 3]
    return TriangleMesh(np.asarray(vertices, float), np.asarray(file["triangles"], np.int64))


def _origin(document: Mapping[str, Any], sheet: SheetStart) -> Any:
    return document["sheets"][sheet.name]["origin"]


def _point(sheet: SheetStart, vertex: int) -> str:
    return _coordinates(sheet.positions[vertex].tolist())


def _coordinates(point: Any) -> str:
    return "({}) m".format(", ".join(f"{value:.4g}" for value in point))


# ---- Holders that tear


def _stretch_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    """Yield holders that pull two vertices further apart than the cloth between them reaches."""
    end = document_end(document)
    for sheet in sheets:
        holders = document["sheets"][sheet.name]["holders"]
        always = [key for key, holder in sorted(holders.items()) if holder["grasp"] is None]
        for key, other in combinations(always, 2):
            time, stretch = _largest_stretch(sheet, holders[key], holders[other], end)
            if stretch <= MAX_STRETCH:
                continue
            rule = (
                f"must not stretch the cloth between it and the holder {key} to more than "
                f"{MAX_STRETCH:g} times its length, and at {time:g} s it is {stretch:.3g} times as "
                "long; bring the two nearer to each other, or let one go with grasp"
            )
            location = ("sheets", sheet.name, "holders", other, "motion")
            yield StartFault(location, rule, {"time": time})


def _largest_stretch(
    sheet: SheetStart, one: Mapping[str, Any], other: Mapping[str, Any], end: float
) -> tuple[float, float]:
    """Return when two holders stretch the cloth between them most [s], and the stretch there.

    It is a lower bound: the cloth between two vertices is no shorter than the distance of both.
    """
    held = [_some(np.flatnonzero(held_vertices(sheet, holder))) for holder in (one, other)]
    if sheet.jitter or not len(held[0]) or not len(held[1]):
        return 0.0, 0.0
    tracks = [None if h["motion"] is None else Track(h["motion"]) for h in (one, other)]
    times = {time for track in tracks if track for time in track.times.tolist() if time <= end}
    # The flat sheet is the longest that the cloth between two vertices can be without a stretch.
    lengths = np.linalg.norm(sheet.rest[held[0]][:, None] - sheet.rest[held[1]][None], axis=2)
    largest = (0.0, 0.0)
    for time in sorted(times):
        points = []
        for vertices, track, holder in zip(held, tracks, (one, other), strict=True):
            at_start = sheet.positions[vertices]
            middle = sheet.positions[held_vertices(sheet, holder)].mean(axis=0)
            points.append(at_start if track is None else track.moved(at_start, middle, time))
        distances = np.linalg.norm(points[0][:, None] - points[1][None], axis=2)
        stretch = float((distances / np.maximum(lengths, 1e-300)).max())
        if stretch > largest[1]:
            largest = (time, stretch)
    return largest


def _some(vertices: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return at most `COMPARED_VERTICES` of some vertices, evenly spread."""
    count = min(len(vertices), COMPARED_VERTICES)
    if not count:
        return vertices
    return vertices[np.linspace(0, len(vertices) - 1, count).astype(np.int64)]
