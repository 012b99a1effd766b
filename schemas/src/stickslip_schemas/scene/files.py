"""The files of a scene: limits, references by digest, and the arrays that they hold.

What a file is for follows from its location in the document: a flat pattern, a start, a body, a motion
or a texture.
"""

import io
import zipfile
import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.base import ARTIFACT, sha256
from stickslip_schemas.scene.document import MAX_VERTICES, Physics, Scene
from stickslip_schemas.scene.errors import UnfitFileError as UnfitFileError
from stickslip_schemas.scene.gate import MAX_FILE_BYTES, MAX_TRIANGLES, check_file
from stickslip_schemas.scene.parameters import Location, value_at, with_values
from stickslip_schemas.scene.parts import MeshBody

FARTHEST = 100.0
"""Largest coordinate in a file [m]."""

Floats = npt.NDArray[np.float64]
Triangles = npt.NDArray[np.int64]
Arrays = dict[str, npt.NDArray[Any]]

_Shapes = dict[str, tuple[str | int, ...]]
_MESH: _Shapes = {"triangles": ("triangle", 3), "times": ("frame",)}
_FRAMES: _Shapes = {"positions": ("frame", "vertex", 3), **_MESH}
_SKIN: _Shapes = {
    "rest": ("vertex", 3),
    "weights": ("vertex", "bone"),
    "bones": ("frame", "bone", 3, 4),
    **_MESH,
}


def inlined(scene: Scene, read: Callable[[str], bytes]) -> tuple[Scene, dict[str, bytes]]:
    """Return a scene with references by digest instead of names of files, and these files by
    digest.

    `read` returns the bytes of a file by its name. Raises UnfitFileError for a file that is not
    what the scene needs there; the message begins with the location.
    """
    values: dict[Location, Any] = {}
    found: dict[str, bytes] = {}
    for location, name in scene.files():
        if name.startswith(ARTIFACT):
            continue
        try:
            data = read(name)
            if (
                counts := _counts(
                    location, {} if location[0] == "looks" else read_file(location, data)
                )
            ) is not None:
                values[(*location[:-1], "counts")] = counts
        except (UnfitFileError, OSError) as error:
            rule = (
                str(error)
                if isinstance(error, UnfitFileError)
                else f"must be readable: {error.strerror}"
            )
            raise UnfitFileError(f"{'.'.join(map(str, location))}: {rule}, in {name}") from error
        digest = sha256(data)
        found[digest] = data
        values[location] = f"{ARTIFACT}{digest}"
    return Scene.model_validate(with_values(scene.model_dump(mode="json"), values)), found


def with_arrays(physics: Physics, read: Callable[[str], bytes]) -> dict[str, Any]:
    """Return physics as JSON, but with the arrays of files (see `read_file`) instead of references
    to them.

    `read` returns the bytes of an artifact by its digest. Raises UnfitFileError.
    """
    files = Physics.files(physics)
    arrays = {
        location: read_file(location, read(name.removeprefix(ARTIFACT))) for location, name in files
    }
    found: dict[str, Any] = with_values(
        physics.model_dump(mode="json", include=set(Physics.model_fields)), arrays
    )
    return found


def frames_of(files: Sequence[Path], scene: Scene, name: str) -> bytes:
    """Return a folder of OBJ files, one a frame of the body that names it, as one NPZ file.

    Raise UnfitFileError.
    """
    rates = [
        body.frame_rate
        for body in scene.bodies.values()
        if isinstance(body, MeshBody) and body.file == name
    ]
    if not files or not rates or rates[0] is None:
        raise UnfitFileError("must hold OBJ files, one a frame, of a body with a frame_rate [1/s]")
    frames = [read_obj(file.read_bytes()) for file in files]
    for file, (vertices, triangles, _) in zip(files, frames, strict=True):
        if vertices.shape != frames[0][0].shape or not np.array_equal(triangles, frames[0][1]):
            raise UnfitFileError(
                f"{file.name} must have the vertices and faces of {files[0].name}, in the same "
                "order"
            )
    packed = io.BytesIO()
    times = np.arange(len(files)) / rates[0]
    np.savez(
        packed,
        positions=np.stack([vertices for vertices, _, _ in frames]),
        triangles=frames[0][1],
        times=times,
    )
    return packed.getvalue()


def check_scene_file(scene: Scene, location: Location, data: bytes) -> None:
    """Raise UnfitFileError where a file in the store is not what a scene needs, or has not the
    counts that it gives.
    """
    found, document = read_file(location, data), scene.physics()
    counts = _counts(location, found)
    if counts is not None and (said := value_at(document, (*location[:-1], "counts"))) != list(
        counts
    ):
        raise UnfitFileError(
            f"counts must be the vertices and triangles of the file, {list(counts)}, and are {said}"
        )
    if location[0] == "sheets" and location[2] == "start":
        vertices, expected = found["positions"], scene.sheets[str(location[1])].mesh.shape[0]
        if len(vertices) != expected:
            raise UnfitFileError(
                f"must have the vertices of its sheet, {expected}, and has {len(vertices)}"
            )


def read_file(location: Location, data: bytes) -> Arrays:
    """Return the arrays of a file at a location in the physics; raise UnfitFileError.

    - a flat pattern: `rest` (V, 2), `positions` (V, 3) [m] and `triangles` (T, 3)
    - a start: `positions` (V, 3) [m]
    - a motion: `time` (K) [s], `move` (K, 3) [m] and `turn` (K, 3) [rad]
    - a body: `triangles` (T, 3), `times` (F) [s] and `positions` (F, N, 3) [m] or, of a skin,
      `rest` (N, 3) [m], `weights` (N, B) and `bones` (F, B, 3, 4), x -> A x + b
    """
    check_file(data)
    if location[-1] == "path":
        return _path(data)
    if location[0] == "bodies":
        return _body(data)
    return _start(data) if location[2] == "start" else _pattern(data)


def _counts(location: Location, found: Arrays) -> tuple[int, int] | None:
    """Return the numbers of vertices and triangles of a flat pattern."""
    return (
        (len(found["rest"]), len(found["triangles"]))
        if location[0] == "sheets" and "rest" in found
        else None
    )


def counts_of(data: bytes) -> tuple[int, int] | None:
    """Return the numbers of vertices and triangles of an OBJ file; None of an NPZ or CSV file.

    Raise UnfitFileError.
    """
    check_file(data)
    if data.startswith(b"PK"):
        return None
    if data.startswith(b"time"):
        _path(data)
    else:
        vertices, triangles, _ = read_obj(data)
        return len(vertices), len(triangles)
    return None


def _pattern(data: bytes) -> Arrays:
    vertices, triangles, flat = read_obj(data)
    if flat is None:
        raise UnfitFileError(
            "must have texture coordinates (vt), one for each vertex: the flat pattern [m]"
        )
    u, v = (flat[triangles[:, corner]] - flat[triangles[:, 0]] for corner in (1, 2))
    area = 0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    if not (area > 0).all():
        location = int(np.argmin(area))
        raise UnfitFileError(
            f"all triangles of the flat pattern must have areas above 0 m^2; {location} has "
            f"{area[location]:g}"
        )
    _check_edges(triangles, len(vertices))
    if len(np.unique(triangles)) != len(vertices):
        raise UnfitFileError("must have no vertex without a triangle")
    return {"rest": flat, "positions": vertices, "triangles": triangles}


def _body(data: bytes) -> Arrays:
    if not data.startswith(b"PK"):
        vertices, triangles, _ = read_obj(data)
        _check_edges(triangles, len(vertices))
        _check_areas(vertices, triangles)
        return {"positions": vertices[None], "triangles": triangles, "times": np.zeros(1)}
    found = _arrays(data, _SKIN if "rest" in _names(data) else _FRAMES)
    triangles = found["triangles"].astype(np.int64)
    count = found["rest" if "rest" in found else "positions"].shape[-2]
    _ascending(found["times"])
    if (
        wrong := found["triangles"][
            (triangles != found["triangles"]) | (triangles < 0) | (triangles >= count)
        ]
    ).size:
        raise UnfitFileError(f"triangles must be vertices, 0 to {count - 1}, and has {wrong[0]}")
    _check_edges(triangles, count)
    _check_areas(found["rest"] if "rest" in found else found["positions"][0], triangles)
    return {**found, "triangles": triangles}


def _start(data: bytes) -> Arrays:
    if not data.startswith(b"PK"):
        return {"positions": read_obj(data)[0]}
    return _arrays(data, {"positions": ("vertex", 3)})


def _path(data: bytes) -> Arrays:
    if data.startswith(b"PK"):
        found = _arrays(data, {"time": ("time",), "move": ("time", 3), "turn": ("time", 3)})
        _ascending(found["time"])
        return found
    lines = _text(data).splitlines()
    if not lines or lines[0].replace(" ", "") != "time,x,y,z,rx,ry,rz":
        raise UnfitFileError(
            "must begin with the line time,x,y,z,rx,ry,rz, and begins with "
            f"{''.join(lines[:1])[:80]!r}"
        )
    rows = []
    for number, line in enumerate(lines[1:], 2):
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != 7 or not np.isfinite(row).all() or max(map(abs, row[1:4])) > FARTHEST:
            raise UnfitFileError(
                f"line {number} must be seven finite numbers [s, m, rad], and is {line[:80]!r}"
            )
        rows.append(row)
    table = np.array(rows).reshape(-1, 7)
    _ascending(table[:, 0])
    return {"time": table[:, 0], "move": table[:, 1:4], "turn": table[:, 4:]}


def _ascending(times: Floats) -> None:
    if not len(times) or times[0] < 0 or not (np.diff(times) > 0).all():
        shown = ", ".join(f"{time:g}" for time in times[:8])
        raise UnfitFileError(
            f"times must be instants that ascend from 0 s or later, and are {shown or 'none'} [s]"
        )


def _names(data: bytes) -> dict[str, int]:
    """Return the arrays of an NPZ file with their sizes [bytes], before anything is decompressed."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return {
                info.filename.removesuffix(".npy"): info.file_size for info in archive.infolist()
            }
    except (zipfile.BadZipFile, OSError) as error:
        raise UnfitFileError(f"must be an NPZ file: {error}") from error


def _arrays(data: bytes, shapes: _Shapes) -> Arrays:
    """Return the arrays of an NPZ file: sides of their shapes with the same name must be equal."""
    sizes = _names(data)
    if missing := [name for name in shapes if name not in sizes]:
        raise UnfitFileError(f"must have {', '.join(shapes)}, and {', '.join(missing)} is missing")
    if sum(sizes.values()) > MAX_FILE_BYTES:
        raise UnfitFileError(
            f"must have at most {MAX_FILE_BYTES} bytes when unpacked, and has {sum(sizes.values())}"
        )
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            found = {name: file[name] for name in shapes}
    except (ValueError, OSError, zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise UnfitFileError(f"must be an NPZ file of plain arrays: {error}") from error
    sides: dict[Any, int] = {3: 3, 4: 4}
    for name, values in found.items():
        shape = shapes[name]
        expected = ", ".join(str(sides.get(side, side)) for side in shape)
        if values.ndim != len(shape) or not all(
            n and n == sides.setdefault(side, n)
            for side, n in zip(shape, values.shape, strict=True)
        ):
            raise UnfitFileError(f"{name} must be ({expected}), and is {values.shape}")
        if values.dtype.kind not in "fiu" or not np.isfinite(values).all():
            raise UnfitFileError(
                f"{name} must be finite numbers, and is {values.dtype} with others"
            )
        if (
            values.dtype.kind == "f"
            and values.size
            and np.abs(values).max() > FARTHEST
            and "time" not in name
        ):
            raise UnfitFileError(
                f"{name} must be within {FARTHEST:g} m, and reaches {np.abs(values).max():g} m"
            )
    return found


def _check_edges(triangles: Triangles, vertices: int) -> None:
    """Raise UnfitFileError where more than two triangles share an edge, or two that are turned
    against each other.
    """
    if vertices > MAX_VERTICES or len(triangles) > MAX_TRIANGLES:
        raise UnfitFileError(
            f"must have at most {MAX_VERTICES} vertices and {MAX_TRIANGLES} triangles, and has "
            f"{vertices} and "
            f"{len(triangles)}"
        )
    if len(same := np.flatnonzero((triangles == np.roll(triangles, 1, axis=1)).any(axis=1))):
        raise UnfitFileError(
            f"a triangle must have three vertices, and triangle {same[0]} names one twice"
        )
    edges = np.concatenate([triangles[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))])
    _, counts = np.unique(edges, axis=0, return_counts=True)
    if (counts > 1).any():
        raise UnfitFileError(
            "must be a manifold: at most two triangles share an edge, turned alike; "
            f"{int((counts > 1).sum())} edges are not so"
        )


def _check_areas(vertices: Floats, triangles: Triangles) -> None:
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    height = (
        np.linalg.norm(np.cross(b - a, c - a), axis=1)
        / np.maximum(((b - a) ** 2).sum(axis=1), 1e-300) ** 0.5
    )
    if len(flat := np.flatnonzero(height <= 1e-12)):
        raise UnfitFileError(
            f"all triangles must have areas above 0 m^2, and triangle {flat[0]} has none"
        )


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise UnfitFileError(f"must be text in UTF-8, or an NPZ file: {error}") from error


def read_obj(data: bytes) -> tuple[Floats, Triangles, Floats | None]:
    """Return the vertices (N, 3), triangles (T, 3) and, if each vertex has one, texture coordinates
    (N, 2).

    Raises UnfitFileError for a line that is no vertex or face.
    """
    vertices: list[list[float]] = []
    texture: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    flat: dict[int, int] = {}
    for number, line in enumerate(_text(data).splitlines(), 1):
        word, *rest = line.split() or [""]
        try:
            if word in ("v", "vt"):
                wanted = 3 if word == "v" else 2
                numbers = [float(text) for text in rest[:wanted]]
                if len(numbers) != wanted or not all(abs(value) <= FARTHEST for value in numbers):
                    raise ValueError
                (vertices if word == "v" else texture).append(numbers)
            elif word == "f":
                corners = [_corner(text, len(vertices), len(texture)) for text in rest]
                if len(corners) < 3:
                    raise ValueError
                for vertex, of_texture in corners:
                    if of_texture is not None and flat.setdefault(vertex, of_texture) != of_texture:
                        raise UnfitFileError(
                            f"line {number}: a vertex must have one texture coordinate, and "
                            f"{vertex + 1} has two"
                        )
                names = [vertex for vertex, _ in corners]
                triangles += [(names[0], b, c) for b, c in pairwise(names[1:])]
        except UnfitFileError:
            raise
        except (ValueError, IndexError) as error:
            rule = f"must be a vertex within {FARTHEST:g} m or a face of its vertices"
            raise UnfitFileError(f"line {number} {rule}, and is {line.strip()[:80]!r}") from error
    if not triangles:
        raise UnfitFileError("must have faces, and has none")
    every = (
        [texture[flat[vertex]] for vertex in range(len(vertices))]
        if len(flat) == len(vertices)
        else None
    )
    return np.array(vertices), np.array(triangles), None if every is None else np.array(every)


def _corner(text: str, vertices: int, texture: int) -> tuple[int, int | None]:
    """Return a corner of a face from 0: an OBJ file counts from 1, or from -1 back from the last
    one.
    """
    found: list[int | None] = []
    for word, count in zip(text.split("/"), (vertices, texture), strict=False):
        number = int(word) if word else 0
        if abs(number) > count or (not number and (word or not found)):
            raise ValueError
        found.append(None if not number else number - 1 if number > 0 else count + number)
    assert found[0] is not None
    return found[0], found[1] if len(found) > 1 else None
