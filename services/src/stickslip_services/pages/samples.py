"""Arrays of single samples, read from the shards in the store, and what moves in a sample over
time.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.base import Sha256
from stickslip_schemas.format.codecs import (
    MISSING,
    decode_chunk,
    decode_sample,
    decode_shard_index,
    shard_index_size,
)
from stickslip_schemas.format.manifest import Contents, FileEntry, Rejection, layout
from stickslip_schemas.kinds.cloth_drag import ClothDragSpec
from stickslip_schemas.kinds.cloth_scene import ClothSceneSpec
from stickslip_schemas.scene.files import with_arrays
from stickslip_schemas.spec.arrays import ArrayLayout
from stickslip_schemas.store import Store

Array = npt.NDArray[np.generic]


class SampleData:
    """The arrays of a version by name, whose files the manifest lists."""

    def __init__(self, store: Store, contents: Contents) -> None:
        self.contents = contents
        self.manifest = manifest = contents.manifest
        self.arrays = {array.name: array for array in layout(manifest.spec)}
        self.store = store

    def read(self, name: str, slot: int) -> Array:
        """Return the value of an array for a sample; raise KeyError, OSError or CorruptChunkError."""
        array = self.arrays[name]
        size = self.manifest.spec.samples_per_file(array)
        file = self._file(array, slot // size)
        return (
            _chunk(self.store, file, array, slot % size, size)
            if array.per_sample
            else _column(self.store, file.sha256, array, size)[slot % size]
        )

    def label(self, name: str) -> Array:
        array = self.arrays[name]
        size = self.manifest.spec.samples_per_file(array)
        files = (
            self._file(array, number) for number in range(-(-self.manifest.sample_count // size))
        )
        columns = [_column(self.store, file.sha256, array, size) for file in files]
        return np.concatenate(columns)[: self.manifest.sample_count]

    def rejection(self, slot: int) -> Rejection | None:
        """Return the rejection of a sample, None for a valid one."""
        rejections = self.contents.section(self.contents.number_of(slot)).rejections
        return next((rejection for rejection in rejections if rejection.slot == slot), None)

    def _file(self, array: ArrayLayout, number: int) -> FileEntry:
        path = array.shard_path(number)
        file = self.contents.file(path)
        if file is None:
            raise KeyError(path)
        return file

    def named(self, array: ArrayLayout, value: Array) -> object:
        """Return a label for display: the name of a code, a number, or several numbers."""
        if array.categories:
            code = int(value)
            return array.categories[code] if 0 <= code < len(array.categories) else "none"
        return (
            value.item() if value.ndim == 0 else ", ".join(f"{item:.4g}" for item in value.ravel())
        )


@lru_cache(maxsize=4)
def _chunk(store: Store, file: FileEntry, array: ArrayLayout, position: int, slots: int) -> Array:
    """Return the value of the sample at `position` of a shard; raise KeyError if it was rejected."""
    tail = shard_index_size(slots)
    index = decode_shard_index(store.read(file.sha256, offset=file.size - tail, length=tail), slots)
    offset, length = (int(value) for value in index[position])
    if offset == MISSING:
        raise KeyError(array.name)
    chunk = store.read(file.sha256, offset=offset, length=length)
    out = np.empty(array.shape, dtype=array.dtype)
    decode_sample(array, chunk, out)
    return out


@lru_cache(maxsize=256)
def _column(store: Store, digest: Sha256, array: ArrayLayout, slots: int) -> Array:
    """Return the values of all samples of a file. Artifacts never change, so they are cached."""
    out = np.empty((slots, *array.shape), dtype=array.dtype)
    decode_chunk(store.read(digest), out)
    return out


MOST_NUMBERS = 600_000
"""Coordinates that a page is sent, about 3 MB: of a longer motion it gets fewer instants, evenly
spread.
"""

LEAST_INSTANTS = 20

UNIT = 1e-4
"""Of the coordinates, which are whole numbers: of 1 m, or of the length of a rod."""

Floats = npt.NDArray[np.float64]


def is_path(array: ArrayLayout) -> bool:
    """Return whether an array holds points in space: of a rod, of a cloth, or of a sheet of a
    scene.
    """
    is_place = array.dimensions[-2:-1] and array.dimensions[-2].split(".")[-1] in (
        "point",
        "vertex",
    )
    return bool(is_place) and array.dimensions[-1] == "xyz" and len(array.shape) in (2, 3)


def motion(data: SampleData, slot: int) -> dict[str, Any]:
    """Return what the view of a sample draws, as JSON.

    Raise KeyError where the sample or its paths are missing.

    Coordinates (instant, vertex x xyz) are whole numbers of `UNIT`; poses (instant, 12) are rows of
    x -> A x + b [m].
    """
    named = [name for name, array in data.arrays.items() if is_path(array)]
    tracks = {name: np.asarray(data.read(name, slot), dtype=float) for name in named}
    tracks = {name: track if track.ndim == 3 else track[None] for name, track in tracks.items()}
    if not tracks:
        raise KeyError("positions")
    bodies = _bodies(data, slot)
    moving = [*tracks.values(), *(body["points"] for body in bodies if "points" in body)]
    most = max(LEAST_INSTANTS, MOST_NUMBERS // sum(path[0].size for path in moving))
    count = max(len(path) for path in moving)
    chosen = np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))
    sheets = []
    for name, track in tracks.items():
        own = name.removesuffix("positions")
        sheet = {"name": own.rstrip(".") or name, "points": _whole(track, chosen)}
        if f"{own}triangles" in data.arrays:
            sheet["triangles"] = data.read(f"{own}triangles", slot).ravel().tolist()
        if f"{own}contact" in data.arrays:
            states = np.asarray(data.read(f"{own}contact", slot))[chosen]
            sheet["contact"] = ["".join(map(str, row)) for row in states.tolist()]
        sheets.append(sheet)
    holders = _holders(data, slot, tracks)
    for thing in (*bodies, *holders):
        thing |= {
            key: thing[key][chosen].reshape(len(chosen), -1).tolist()
            for key in ("poses", "holds")
            if key in thing
        }
        thing |= {key: _whole(thing[key], chosen) for key in ("points",) if key in thing}
    return {
        "unit": UNIT,
        "instants": chosen.tolist(),
        "sheets": sheets,
        "bodies": bodies,
        "holders": holders,
    }


def _whole(track: Floats, chosen: npt.NDArray[np.int64]) -> list[list[int]]:
    some = track[np.minimum(chosen, len(track) - 1)]
    return np.asarray(np.rint(np.nan_to_num(some) / UNIT), int).reshape(len(some), -1).tolist()


def _bodies(data: SampleData, slot: int) -> list[dict[str, Any]]:
    """Return the bodies of the scene with the sample's own numbers, and their poses (instant, 3,
    4).
    """
    spec = data.manifest.spec
    if isinstance(spec, ClothDragSpec):
        return [{"type": "plane", "normal": [0, 0, 1]}]  # its floor, at z = 0
    if not isinstance(spec, ClothSceneSpec) or "body_pose" not in data.arrays:
        return []
    numbers = [
        name for name in spec.stage.parameters if isinstance(spec.stage.default(name), float)
    ]
    own = {
        place: float(data.read(name, slot))
        for name in numbers
        for place in spec.stage.locations(name)
    }
    document = with_arrays(spec.stage.physics_with(own), data.store.read)
    poses = np.asarray(data.read("body_pose", slot), dtype=float)
    times = np.arange(len(poses)) / spec.instants_per_second
    found = []
    for number, (name, body) in enumerate(document["bodies"].items()):
        shown = {
            key: body[key]
            for key in ("type", "normal", "radius", "length", "size", "rounding")
            if key in body
        }
        if body["type"] == "mesh":
            shown["points"] = deformed(body["file"], body["strength"], times)
            shown["triangles"] = body["file"]["triangles"].ravel().tolist()
        found.append(shown | {"name": name, "poses": poses[:, number]})
    return found


def deformed(file: Mapping[str, Any], strength: float, times: Floats) -> Floats:
    """Return the vertices (time, vertex, xyz) [m] of a body of triangles, straight between the
    frames of its file.

    A skin's vertices are sums over bones of w (A x + b); `strength` scales all displacements since
    the first time.
    """
    frames = np.asarray(file["bones"] if "bones" in file else file["positions"], dtype=float)
    place = np.interp(times, file["times"], np.arange(len(frames)))
    low = np.minimum(place.astype(int), max(len(frames) - 2, 0))
    share = (place - low).reshape(-1, *[1] * (frames.ndim - 1))
    moved = (1 - share) * frames[low] + share * frames[np.minimum(low + 1, len(frames) - 1)]
    if "bones" in file:
        turned = np.einsum(
            "nb,tbij,nj->tni", file["weights"], moved[..., :3], file["rest"], optimize=True
        )
        moved = turned + np.einsum("nb,tbi->tni", file["weights"], moved[..., 3])
    found: Floats = moved[:1] + strength * (moved - moved[:1])
    return found


def _holders(data: SampleData, slot: int, tracks: Mapping[str, Floats]) -> list[dict[str, Any]]:
    """Return the poses of holders (instant, 3, 4), and whether they hold (instant)."""
    spec = data.manifest.spec
    if isinstance(spec, ClothDragSpec):  # at both corners of the upper edge
        rest, (track,) = np.asarray(data.read("rest", slot), dtype=float), tracks.values()
        corners = [np.argmax(rest @ direction) for direction in ((-1, 1), (1, 1))]
        still = np.broadcast_to(np.eye(3), (len(track), 3, 3))
        at = [np.concatenate([still, track[:, corner, :, None]], axis=2) for corner in corners]
        return [{"poses": poses, "holds": np.ones(len(track), int)} for poses in at]
    if not isinstance(spec, ClothSceneSpec) or "holder_pose" not in data.arrays:
        return []
    poses, holds = (np.asarray(data.read(name, slot)) for name in ("holder_pose", "grasped"))
    all_ = [spec.stage.sheets[sheet].holders[name] for sheet, name in spec.stage.holders]
    grips = [
        number for number, holder in enumerate(all_) if holder.rim is None
    ]  # a rim has no one place
    return [{"poses": poses[:, number], "holds": holds[:, number]} for number in grips]
