"""Whether a scene can start: what the simulation would refuse, or could never bring to an end.

The rules are those of the simulation core, found here by geometry alone, so that a coordinator
without the core refuses a scene before anything is queued:

    sizes       triangles of bodies and rows of paths within what can be compared (`sizes`)
    sheets      together within the size that the solver takes, thinner than their cells, each in
                one piece
    holders     hold a vertex each, none twice, and leave one free
    bodies      are round against the cells of the sheets
    gaps        are not so large that units must differ
    start       no sheet inside a body, across another thing, or at no distance from it
    motions     no faster than the shortest steps of the preset can follow
    holders     do not tear the cloth between them
    presses     leave room for the cloth between two bodies (`presses`)

A hung sheet is compared with bodies where geometry tells how it hangs (`hanging`).
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.box_trees import MAX_COMPARED_PAIRS, TooManyPairsError, Workload
from stickslip_schemas.scene.errors import UnfitStartError
from stickslip_schemas.scene.geometry import (
    TriangleMesh,
    are_apart,
    find_crossing,
    find_self_crossing,
    find_touch,
)
from stickslip_schemas.scene.hanging import hung_positions, uncertainty
from stickslip_schemas.scene.mesh_bodies import MovingMesh, moving_meshes
from stickslip_schemas.scene.motion_faults import motion_faults, stretch_faults
from stickslip_schemas.scene.parameters import Location
from stickslip_schemas.scene.presses import press_faults
from stickslip_schemas.scene.shapes import RADIUS_LEAST, box_rounding, start_gap, with_roundings
from stickslip_schemas.scene.sheets import SLACK, SheetStart, held_vertices, start_of
from stickslip_schemas.scene.sizes import gap_faults, size_faults
from stickslip_schemas.spec.jobs import StartFault

Floats = npt.NDArray[np.float64]

MAX_EXTENT = 20.0
"""Largest length and width of all sheets, side by side [m]: `EXTENT_MAX` of the solver."""

MAX_SIZE_RATIO = 3.0
"""Lengths at the start over those of the flat pattern, or the inverse, from which units differ.

The solver brings sheets of 1.4 times their size back into shape, and those of 3 times never."""

MAX_DEPTH = 1e-6
"""Depth of a free vertex in a body from which the solver refuses a start [m]."""

LEAST_DISTANCE = 1e-7
"""Distance from which two things have a direction that parts them [m].

At 1 um the solver starts and pushes them apart. At 0 it has no direction, and never ends.
"""


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
    faults = list(size_faults(document))
    # Nothing is compared in a scene that is too large for it.
    if faults:
        return faults
    sheets = [start_of(name, sheet) for name, sheet in sorted(document["sheets"].items())]
    faults += _sheet_faults(document, sheets)
    faults += _holder_faults(document, sheets)
    end = document_end(document)
    meshes = moving_meshes(document)
    faults += motion_faults(document, sheets, meshes, end)
    # Geometry of a wrong unit or shape would only repeat these faults in many other words.
    if not faults:
        faults += _radius_faults(document, sheets)
    cell = max(sheet.cell for sheet in sheets)
    document = {**document, "bodies": with_roundings(document["bodies"], cell)}
    if not faults:
        faults += gap_faults(document, sheets, meshes)
    if not faults:
        faults += _body_faults(document, sheets)
    if not faults:
        faults += stretch_faults(document, sheets, end)
    if not faults:
        faults += _crowded_faults(document, sheets, meshes, end)
    return faults


def _crowded_faults(
    document: Mapping[str, Any],
    sheets: list[SheetStart],
    meshes: Mapping[str, MovingMesh],
    end: float,
) -> list[StartFault]:
    """Return the faults of starts and presses, or that too many triangles are near each other."""
    workload = Workload(MAX_COMPARED_PAIRS)
    try:
        faults = list(_contact_faults(document, sheets, meshes, workload))
        if not faults:
            faults += press_faults(document, sheets, meshes, end, workload)
    except TooManyPairsError:
        rule = (
            f"must be so far from each other and from bodies that at most {MAX_COMPARED_PAIRS} "
            "pairs of boxes around their triangles have to be compared, as each step of a "
            "simulation does: cut long slanted triangles into shorter ones, make meshes coarser, "
            "or move things apart"
        )
        return [StartFault(("sheets",), rule, sorted(document["sheets"]))]
    return faults


# ---- Sheets by themselves


def _sheet_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    for sheet in sheets:
        values = document["sheets"][sheet.name]
        member = "file" if values["mesh"]["type"] == "file" else "size"
        location = ("sheets", sheet.name, "mesh", member)
        if sheet.pieces > 1:
            rule = (
                "must have triangles that hang together in 1 piece: weld vertices at equal "
                "positions, or make a sheet of each piece"
            )
            yield StartFault(location, rule, sheet.pieces)
        # A sheet that passes through itself is nowhere too near to itself.
        if values["self_contact"] and sheet.least_height <= values["thickness"]:
            rule = (
                f"must have triangles that are higher than the sheet is thick, which is "
                f"{values['thickness']:g} m: give lengths in metres, fewer cells, or a smaller "
                "thickness"
            )
            yield StartFault(location, rule, sheet.least_height)
        ratio = _size_ratio(sheet)
        if values["start"]["type"] == "file" and not 1.0 / MAX_SIZE_RATIO < ratio < MAX_SIZE_RATIO:
            rule = (
                "must have edges about as long as in the flat pattern, and they are "
                f"{ratio:.3g} times as long: give both in metres (texture coordinates of most "
                "programs go from 0 to 1)"
            )
            yield StartFault(("sheets", sheet.name, "start"), rule, "file")
    total = sum(float(np.ptp(sheet.rest[:, 0])) for sheet in sheets)
    if len(sheets) > 1 and total > MAX_EXTENT:
        rule = (
            f"must be at most {MAX_EXTENT:g} m wide together, side by side: make them smaller, or "
            "a scene of each"
        )
        yield StartFault(("sheets",), rule, total)


def _size_ratio(sheet: SheetStart) -> float:
    """Return how many times as long as in the flat sheet the edges are at the start: the median."""
    edges = sheet.mesh.triangles[:, :2]
    begin, end = edges.T
    lengths = np.linalg.norm(sheet.positions[end] - sheet.positions[begin], axis=1)
    flat_lengths = np.linalg.norm(sheet.rest[end] - sheet.rest[begin], axis=1)
    return float(np.median(lengths / np.maximum(flat_lengths, 1e-300)))


# ---- Holders


def _holder_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    for sheet in sheets:
        held_before = np.zeros(len(sheet.rest), dtype=bool)
        holders = document["sheets"][sheet.name]["holders"]
        for key, holder in sorted(holders.items()):
            location: Location = ("sheets", sheet.name, "holders", key)
            held = held_vertices(sheet, holder, margin=-sheet.jitter)
            if not held_vertices(sheet, holder, margin=sheet.jitter).any():
                yield StartFault(location, _beside(sheet, holder), _area_of(holder))
            elif (held & held_before).any():
                vertex = int(np.argmax(held & held_before))
                rule = f"must not hold vertex {vertex}, which another holder holds; move it aside"
                yield StartFault(location, rule, _area_of(holder))
            held_before |= held
        # What is let go becomes free, so only holders that always hold leave nothing to simulate.
        always = all(holder["grasp"] is None for holder in holders.values())
        if held_before.all() and always and len(sheets) == 1:
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


def document_end(document: Mapping[str, Any]) -> float:
    """Return the time at which a scene ends at the latest [s]."""
    end = document["end"]
    return float(document["duration"] if end is None else end["at_most"])


# ---- Bodies that are sharp against a cell


def _radius_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    """Yield bodies with a smaller radius than cells can slide over (`RADIUS_LEAST`)."""
    coarsest = max(sheets, key=lambda sheet: sheet.cell)
    # The side of a cell is a rounded number, and radii are often multiples of it.
    least = (1.0 - SLACK) * RADIUS_LEAST * coarsest.cell
    for name, body in sorted(document["bodies"].items()):
        if body["type"] in ("plane", "mesh"):
            continue
        is_box = body["type"] == "box"
        radius = box_rounding(body, coarsest.cell) if is_box else body["radius"]
        if radius >= least:
            continue
        is_thin = is_box and body["rounding"] is None
        member = "size" if is_thin else "rounding" if is_box else "radius"
        asked = f"{2 * RADIUS_LEAST:g} cells thick" if is_thin else f"{RADIUS_LEAST:g} cells"
        # Rounded up, so that the number that the message names is enough.
        metres = np.ceil(1e6 * (2 * least if is_thin else least)) / 1e6
        rule = (
            f"must be at least {asked}, which is {metres:g} m with the sheet "
            f"{coarsest.name}: cells of {coarsest.cell:.3g} m catch on what is sharper; make it "
            "larger, or the sheet finer"
        )
        yield StartFault(("bodies", name, member), rule, body[member])


# ---- Starts in and across others


def _body_faults(document: Mapping[str, Any], sheets: list[SheetStart]) -> Iterator[StartFault]:
    """Yield sheets with a free vertex inside a body that has an inside."""
    for sheet in sheets:
        positions = _known_positions(document, sheet)
        if positions is None:
            continue
        free = ~_held_at_start(document, sheet)
        least_depth = uncertainty(sheet) if sheet.is_hung else max(MAX_DEPTH, sheet.jitter)
        for name, body in sorted(document["bodies"].items()):
            if body["type"] == "mesh":
                continue
            depth = np.where(free, -start_gap(body, positions), -np.inf)
            vertex = int(np.argmax(depth))
            if depth[vertex] <= least_depth:
                continue
            hangs = "where it hangs, " if sheet.is_hung else ""
            rule = (
                f"must start outside of all bodies, and {hangs}vertex {vertex} of the sheet is "
                f"{1e3 * depth[vertex]:.3g} mm inside {name}, near "
                f"{_coordinates(positions[vertex].tolist())}; move the sheet or the body by more "
                "than that"
            )
            yield StartFault(("sheets", sheet.name, "origin"), rule, _origin(document, sheet))
            break


def _known_positions(document: Mapping[str, Any], sheet: SheetStart) -> Floats | None:
    """Return where the vertices of a sheet start (V, 3) [m]; None if only a simulation tells."""
    return hung_positions(document, sheet) if sheet.is_hung else sheet.positions


def _held_at_start(document: Mapping[str, Any], sheet: SheetStart) -> npt.NDArray[np.bool_]:
    held = np.zeros(len(sheet.rest), dtype=bool)
    for holder in document["sheets"][sheet.name]["holders"].values():
        if holder["grasp"] is None or holder["grasp"][0] == 0.0:
            held |= held_vertices(sheet, holder)
    return held


def _contact_faults(
    document: Mapping[str, Any],
    sheets: list[SheetStart],
    meshes: Mapping[str, MovingMesh],
    workload: Workload,
) -> Iterator[StartFault]:
    """Yield sheets that cross themselves, other sheets or triangles of bodies, or lie in them."""
    standing = [sheet for sheet in sheets if not sheet.is_hung]
    surfaces = [(name, mesh.surface) for name, mesh in meshes.items()]
    for number, sheet in enumerate(standing):
        self_contact = document["sheets"][sheet.name]["self_contact"]
        # A flat sheet cannot cross itself.
        if self_contact and not sheet.is_flat:
            crossing = find_self_crossing(sheet.mesh, workload)
            if crossing is not None:
                rule = (
                    f"must not cross itself, and triangle {crossing.first} crosses triangle "
                    f"{crossing.second}, near {_coordinates(crossing.point)}; start it unfolded, "
                    "or set self_contact to false"
                )
                location = ("sheets", sheet.name, "start")
                yield StartFault(location, rule, document["sheets"][sheet.name]["start"]["type"])
        obstacles = [(f"sheet {other.name}", other.mesh) for other in standing[:number]]
        obstacles += [(f"body {name}", mesh) for name, mesh in surfaces]
        for name, mesh in obstacles:
            rule = _meeting(sheet, name, mesh, workload)
            if rule:
                location = ("sheets", sheet.name, "origin")
                yield StartFault(location, rule, _origin(document, sheet))
                break
    for sheet in sheets:
        if sheet.is_hung:
            yield from _hung_faults(document, sheet, surfaces, workload)


def _hung_faults(
    document: Mapping[str, Any],
    sheet: SheetStart,
    surfaces: list[tuple[str, TriangleMesh]],
    workload: Workload,
) -> Iterator[StartFault]:
    """Yield the body of triangles that a hung sheet crosses wherever in its plane it may be."""
    positions = hung_positions(document, sheet)
    if positions is None or not surfaces:
        return
    # The sheet hangs in an upright plane, and crosses for certain what it crosses on both sides.
    level = np.cross(positions[-1] - positions[0], [0.0, 0.0, 1.0])
    shift = uncertainty(sheet) * level / max(float(np.linalg.norm(level)), 1e-300)
    sides = [
        TriangleMesh(positions + side * shift, sheet.mesh.triangles) for side in (0.0, -1.0, 1.0)
    ]
    for name, mesh in surfaces:
        crossings = [find_crossing(side, mesh, workload) for side in sides]
        if crossings[0] is None or None in crossings:
            continue
        rule = (
            f"must not cross body {name} where it hangs, and triangle {crossings[0].first} of the "
            f"sheet crosses triangle {crossings[0].second} of it, near "
            f"{_coordinates(crossings[0].point)}; move them apart"
        )
        yield StartFault(("sheets", sheet.name, "origin"), rule, _origin(document, sheet))
        return


def _meeting(sheet: SheetStart, name: str, mesh: TriangleMesh, workload: Workload) -> str:
    """Return the rule that a sheet breaks with another thing; an empty text if it breaks none."""
    if are_apart(sheet.mesh, mesh, LEAST_DISTANCE):
        return ""
    touch = find_touch(sheet.mesh, mesh, LEAST_DISTANCE, workload)
    # Two meshes that lie in each other have millions of candidates, and a fault already.
    crossing = find_crossing(sheet.mesh, mesh, workload, batches=None if touch is None else 1)
    if crossing is not None:
        return (
            f"must not cross {name} at the start, and triangle {crossing.first} of the sheet "
            f"crosses triangle {crossing.second} of it, near {_coordinates(crossing.point)}; move "
            "them apart"
        )
    remedy = "leave half of both thicknesses between them"
    if touch is not None:
        return (
            f"must not lie in {name} at the start, and vertex {touch.vertex} of the sheet is at "
            f"{touch.distance:.2g} m from triangle {touch.triangle} of it, near "
            f"{_point(sheet, touch.vertex)}; {remedy}"
        )
    # Where the other thing is the smaller one, its vertices lie in the sheet.
    touch = find_touch(mesh, sheet.mesh, LEAST_DISTANCE, workload)
    if touch is not None:
        point = _coordinates(mesh.vertices[touch.vertex].tolist())
        return (
            f"must not lie in {name} at the start, and triangle {touch.triangle} of the sheet is "
            f"at {touch.distance:.2g} m from vertex {touch.vertex} of it, near {point}; {remedy}"
        )
    return ""


def _origin(document: Mapping[str, Any], sheet: SheetStart) -> Any:
    return document["sheets"][sheet.name]["origin"]


def _point(sheet: SheetStart, vertex: int) -> str:
    return _coordinates(sheet.positions[vertex].tolist())


def _coordinates(point: Any) -> str:
    return "({}) m".format(", ".join(f"{value:.4g}" for value in point))
