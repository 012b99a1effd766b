"""The motion of a sample for the view in three dimensions: sheets, bodies and holders over time.

Coordinates (instant, vertex x xyz) are whole numbers of `UNIT`, which are half as long in JSON as
fractions. Poses (instant, 12) are rows of x -> A x + b [m].
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.scene.shapes import with_roundings
from stickslip_schemas.scene.sheets import start_of
from stickslip_schemas.spec.arrays import DERIVATIVE_BY, ArrayLayout

from stickslip_services.pages.samples import SampleData

MAX_COORDINATES = 600_000
"""Coordinates that a page is sent, about 3 MB.

A longer motion gets fewer instants, evenly spread.
"""

MIN_INSTANTS = 20
"""Instants of a motion however many vertices it has."""

UNIT = 1e-4
"""Unit of coordinates: 0.1 mm of a scene, or 1/10,000 of the length of a rod."""

_SHOWN_FIELDS = ("type", "normal", "radius", "length", "size", "rounding")
"""Fields of a body that its shape needs."""

Floats = npt.NDArray[np.float64]
Instants = npt.NDArray[np.int64]
Body = dict[str, Any]


def is_path(array: ArrayLayout) -> bool:
    """Return whether an array holds points in space: of a rod, a cloth, or a sheet of a scene."""
    is_derivative = DERIVATIVE_BY in array.attributes
    if is_derivative or len(array.shape) not in (2, 3) or array.dimensions[-1] != "xyz":
        return False
    # A scene has `towel.vertex`, for example.
    return array.dimensions[-2].split(".")[-1] in ("point", "vertex")


def motion(data: SampleData, slot: int) -> dict[str, Any]:
    """Return the motion of a sample as JSON; raise KeyError if it or its paths are missing."""
    tracks = _tracks(data, slot)
    if not tracks:
        raise KeyError("positions")
    bodies = _bodies(data, slot)
    holders = _holders(data, slot, tracks)
    meshes = [body["points"] for body in bodies if "points" in body]
    instants = _chosen_instants([*tracks.values(), *meshes])
    return {
        "unit": UNIT,
        "instants": instants.tolist(),
        "sheets": [_sheet(data, slot, name, track, instants) for name, track in tracks.items()],
        "bodies": [_at_instants(body, instants) for body in bodies],
        "holders": [_at_instants(holder, instants) for holder in holders],
    }


def _tracks(data: SampleData, slot: int) -> dict[str, Floats]:
    """Return the paths of a sample by name (instant, vertex, xyz)."""
    tracks = {}
    for name, array in data.arrays.items():
        if not is_path(array):
            continue
        track = np.asarray(data.read(name, slot), dtype=float)
        # A rod at rest has one instant.
        tracks[name] = track if track.ndim == 3 else track[None]
    return tracks


def _chosen_instants(paths: list[Floats]) -> Instants:
    """Return as many instants, evenly spread, as the limit of coordinates allows."""
    coordinates = sum(path[0].size for path in paths)
    limit = max(MIN_INSTANTS, MAX_COORDINATES // coordinates)
    count = max(len(path) for path in paths)
    return np.unique(np.linspace(0, count - 1, min(count, limit)).astype(int))


def _sheet(
    data: SampleData, slot: int, name: str, track: Floats, instants: Instants
) -> dict[str, Any]:
    """Return a sheet: its points, and its triangles and states of contact if they are stored."""
    # The arrays of the sheet `towel` are `towel.positions`, `towel.triangles` and so on.
    prefix = name.removesuffix("positions")
    sheet: dict[str, Any] = {
        "name": prefix.rstrip(".") or name,
        "points": _in_units(track, instants),
    }
    if f"{prefix}triangles" in data.arrays:
        sheet["triangles"] = data.read(f"{prefix}triangles", slot).ravel().tolist()
    if f"{prefix}contact" in data.arrays:
        # One digit a vertex, and one text an instant.
        states = np.asarray(data.read(f"{prefix}contact", slot))[instants]
        sheet["contact"] = ["".join(map(str, row)) for row in states.tolist()]
    return sheet


def _at_instants(body: Body, instants: Instants) -> Body:
    """Return a body or a holder as JSON, at some instants only."""
    document = dict(body)
    for name in ("poses", "holds"):
        if name in body:
            values = body[name][instants].reshape(len(instants), -1)
            # JSON has no NaN; a pose that is not known is drawn nowhere else.
            document[name] = np.nan_to_num(values).tolist()
    if "points" in body:
        document["points"] = _in_units(body["points"], instants)
    return document


def _in_units(track: Floats, instants: Instants) -> list[list[int]]:
    """Return a path at some instants in whole units; what stands still has one instant for all."""
    points = track[np.minimum(instants, len(track) - 1)]
    units = np.rint(np.nan_to_num(points) / UNIT)
    rows: list[list[int]] = units.astype(int).reshape(len(points), -1).tolist()
    return rows


def _bodies(data: SampleData, slot: int) -> list[Body]:
    """Return the bodies with the sample's own numbers, and their poses (instant, 3, 4)."""
    spec = data.manifest.spec
    bodies = [dict(body) for body in spec.fixed_bodies]
    if "body_pose" not in data.arrays:
        return bodies
    numbers = {name: float(data.read(name, slot)) for name in spec.scene_numbers}
    scene = spec.sample_scene(numbers, data.store.read)
    if scene is None:
        return bodies
    cell = max(start_of(name, sheet).cell for name, sheet in scene["sheets"].items())
    poses = np.asarray(data.read("body_pose", slot), dtype=float)
    times = np.arange(len(poses)) / scene["frame_rate"]
    for number, (name, document) in enumerate(with_roundings(scene["bodies"], cell).items()):
        body = {key: document[key] for key in _SHOWN_FIELDS if key in document}
        body["name"] = name
        body["poses"] = poses[:, number]
        if document["type"] == "mesh":
            body["points"] = deformed(document["file"], document["strength"], times)
            body["triangles"] = document["file"]["triangles"].ravel().tolist()
        bodies.append(body)
    return bodies


def deformed(file: Mapping[str, Any], strength: float, times: Floats) -> Floats:
    """Return the vertices (time, vertex, xyz) [m] of a body of triangles.

    They move straight between the frames of its file. A skin's vertices are sums over bones of
    w (A x + b); `strength` scales all displacements since the first time.
    """
    is_skin = "bones" in file
    frames = np.asarray(file["bones"] if is_skin else file["positions"], dtype=float)

    # Between the frames `low` and `low + 1`, `fraction` of the way.
    position = np.interp(times, file["times"], np.arange(len(frames)))
    low = np.minimum(position.astype(int), max(len(frames) - 2, 0))
    high = np.minimum(low + 1, len(frames) - 1)
    fraction = (position - low).reshape(-1, *[1] * (frames.ndim - 1))
    vertices: Floats = (1 - fraction) * frames[low] + fraction * frames[high]

    if is_skin:
        # Of t times, n vertices, b bones and coordinates i, j: the rotations, then the shifts.
        rotations = vertices[..., :3]
        shifts = vertices[..., 3]
        weights = file["weights"]
        vertices = np.einsum("nb,tbij,nj->tni", weights, rotations, file["rest"], optimize=True)
        vertices = vertices + np.einsum("nb,tbi->tni", weights, shifts)
    start = vertices[:1]
    moved: Floats = start + strength * (vertices - start)
    return moved


def _holders(data: SampleData, slot: int, tracks: Mapping[str, Floats]) -> list[Body]:
    """Return the poses of holders (instant, 3, 4), and whether they hold (instant)."""
    spec = data.manifest.spec
    holders = []
    if spec.held_corners:
        # Held throughout: a holder is where its corner of the only sheet is.
        (track,) = tracks.values()
        rest = np.asarray(data.read("rest", slot), dtype=float)
        no_rotation = np.broadcast_to(np.eye(3), (len(track), 3, 3))
        for direction in spec.held_corners:
            corner = int(np.argmax(rest @ direction))
            positions = track[:, corner, :, None]
            poses = np.concatenate([no_rotation, positions], axis=2)
            holders.append({"poses": poses, "holds": np.ones(len(track), int)})
    if "holder_pose" in data.arrays:
        poses = np.asarray(data.read("holder_pose", slot))
        holds = np.asarray(data.read("grasped", slot))
        for number in spec.located_holders:
            holders.append({"poses": poses[:, number], "holds": holds[:, number]})
    return holders
