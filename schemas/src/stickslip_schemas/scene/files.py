"""The files of a scene: references by digest, and the arrays that files hold.

The location of a file in the document tells its purpose: a flat pattern, a start, a body, a
motion or a texture.
"""

import csv
import io
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from stickslip_schemas.base import ARTIFACT, sha256
from stickslip_schemas.scene.document import Physics, Scene
from stickslip_schemas.scene.errors import UnfitFileError as UnfitFileError
from stickslip_schemas.scene.gate import Arrays, SceneBytes, check_file, is_path_table
from stickslip_schemas.scene.mesh_files import FARTHEST, Polygons, has_order, read_polygons
from stickslip_schemas.scene.parameters import Location, value_at, with_values
from stickslip_schemas.scene.parts import LARGEST, SMALLEST, MeshBody, unit_hint
from stickslip_schemas.scene.polygons import Floats, triangulate, weld
from stickslip_schemas.scene.reading import read_once
from stickslip_schemas.scene.surface_rules import check_areas, check_corners, check_edges

MESH_SUFFIXES = (".obj", ".ply", ".stl")
"""Ends of the names of mesh files."""

PATH_COLUMNS = ("time", "x", "y", "z", "rx", "ry", "rz")
"""Columns of a motion in a CSV file: [s], [m], [rad]."""


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
    """Return a scene with references in place of names of files, and the files by digest.

    `read` returns the bytes of a file by its name. Raises UnfitFileError for a file that the scene
    cannot use there; the message begins with the location.
    """
    values: dict[Location, Any] = {}
    files: dict[str, bytes] = {}
    read_counted = SceneBytes(read_file).read
    for location, name in scene.files():
        if name.startswith(ARTIFACT):
            continue
        try:
            data = read(name)
            # Textures are checked by `format.pictures`, which needs another extra.
            arrays = {} if location[0] == "looks" else read_counted(location, data)
            counts = _pattern_counts(location, arrays)
        except UnfitFileError as error:
            raise UnfitFileError(f"{_dotted(location)}: {error}, in {name}") from error
        except OSError as error:
            rule = f"must be readable: {error.strerror}"
            raise UnfitFileError(f"{_dotted(location)}: {rule}, in {name}") from error
        if counts is not None:
            values[(*location[:-1], "counts")] = counts
        digest = sha256(data)
        files[digest] = data
        values[location] = f"{ARTIFACT}{digest}"
    document = with_values(scene.model_dump(mode="json"), values)
    return Scene.model_validate(document), files


def with_arrays(physics: Physics, read: Callable[[str], bytes]) -> dict[str, Any]:
    """Return physics as JSON, with the arrays of files (see `read_file`) in place of references.

    `read` returns the bytes of an artifact by its digest. Raises UnfitFileError.
    """
    arrays = {}
    read_counted = SceneBytes(read_file).read
    for location, name in Physics.files(physics):
        arrays[location] = read_counted(location, read(name.removeprefix(ARTIFACT)))
    document = physics.model_dump(mode="json", include=set(Physics.model_fields))
    with_files: dict[str, Any] = with_values(document, arrays)
    return with_files


def weld_notes(physics: Physics, files: Mapping[str, bytes]) -> Iterator[str]:
    """Yield a sentence for each body of which vertices at equal positions were welded.

    `files` are by digest. Bodies of other files are left out.
    """
    for location, name in Physics.files(physics):
        data = files.get(name.removeprefix(ARTIFACT))
        if data is not None and location[0] == "bodies" and location[-1] == "file":
            body = read_once(_read_body, data)
            if body.welded_count:
                yield (
                    f"{_dotted(location)}: {body.welded_count} of {body.vertex_count} vertices "
                    "were at the position of another one, and were welded to it."
                )


def check_scene_file(scene: Scene, location: Location, data: bytes) -> None:
    """Raise UnfitFileError if a scene cannot use a file at a location.

    The counts that the document states must be the counts of the file.
    """
    arrays = read_file(location, data)
    counts = _pattern_counts(location, arrays)
    if counts is not None:
        stated = value_at(scene.physics(), (*location[:-1], "counts"))
        if stated != list(counts):
            raise UnfitFileError(
                f"counts must be the vertices and triangles of the file, {list(counts)}, and are "
                f"{stated}"
            )
    if location[0] == "sheets" and location[2] == "start":
        count = len(arrays["positions"])
        expected = scene.sheets[str(location[1])].mesh.shape[0]
        if count != expected:
            raise UnfitFileError(
                f"must have the vertices of its sheet, {expected}, and has {count}"
            )


def read_file(location: Location, data: bytes) -> Arrays:
    """Return the arrays of a file at a location in the physics; raise UnfitFileError.

    - a flat pattern: `rest` (V, 2), `positions` (V, 3) [m] and `triangles` (T, 3)
    - a start: `positions` (V, 3) [m]
    - a motion: `time` (K) [s], `move` (K, 3) [m] and `turn` (K, 3) [rad]
    - a body: `triangles` (T, 3), `times` (F) [s] and `positions` (F, N, 3) [m] or, of a skin,
      `rest` (N, 3) [m], `weights` (N, B) and `bones` (F, B, 3, 4), x -> A x + b
    """
    read_once(check_file, data)
    if location[-1] == "path":
        return read_once(_read_path, data)
    if location[0] == "bodies":
        return read_once(_read_body, data).arrays
    return read_once(_read_start if location[2] == "start" else _read_pattern, data)


def counts_of(data: bytes) -> tuple[int, int] | None:
    """Return the numbers of vertices and triangles of a mesh file; None of an NPZ or CSV file.

    Raises UnfitFileError.
    """
    check_file(data)
    if data.startswith(b"PK"):
        return None
    if is_path_table(data):
        _read_path(data)
        return None
    polygons = read_polygons(data)
    # A polygon of n corners is cut into n - 2 triangles.
    return len(polygons.positions), int((polygons.sizes - 2).sum())


def _dotted(location: Location) -> str:
    return ".".join(map(str, location))


def _pattern_counts(location: Location, arrays: Arrays) -> tuple[int, int] | None:
    """Return the numbers of vertices and triangles of a flat pattern; None of other files."""
    if location[0] != "sheets" or "rest" not in arrays:
        return None
    return len(arrays["rest"]), len(arrays["triangles"])


# ---- Meshes -----------------------------------------------------------------------------------


def _read_pattern(data: bytes) -> Arrays:
    polygons = read_polygons(data, with_pattern=True)
    rest = polygons.pattern
    assert rest is not None
    # Polygons are cut in the flat pattern: the start may be folded.
    triangles = triangulate(rest, polygons.corners, polygons.sizes)
    _check_extent(rest)

    # 2 A = u x v: negative if a triangle is turned against the pattern.
    u = rest[triangles[:, 1]] - rest[triangles[:, 0]]
    v = rest[triangles[:, 2]] - rest[triangles[:, 0]]
    area = 0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    if not (area > 0).all():
        triangle = int(np.argmin(area))
        raise UnfitFileError(
            f"all triangles of the flat pattern must have areas above 0 m^2; {triangle} has "
            f"{area[triangle]:g}: triangles must be turned counterclockwise in the pattern"
        )
    check_corners(triangles)
    check_edges(triangles, len(rest))
    if len(np.unique(triangles)) != len(rest):
        loose = int(np.setdiff1d(np.arange(len(rest)), triangles)[0])
        raise UnfitFileError(
            f"must have no vertex without a triangle, and vertex {loose + 1} has none: delete "
            "loose vertices (in Blender: Mesh, Clean Up, Delete Loose)"
        )
    _check_sewn(rest, polygons.positions)
    return {"rest": rest, "positions": polygons.positions, "triangles": triangles}


def _check_sewn(rest: Floats, positions: Floats) -> None:
    """Raise UnfitFileError if vertices of a sheet are there twice, so that it falls apart.

    They are not welded: lists of held vertices and files of starts count them.
    """
    same = weld(np.column_stack([rest, positions]))
    repeated = len(rest) - len(same.vertices)
    if repeated:
        again = int(np.setdiff1d(np.arange(len(rest)), same.vertices)[0])
        first = int(same.vertices[same.targets[again]])
        raise UnfitFileError(
            "neighbouring triangles must share their vertices, or the sheet falls apart; "
            f"{repeated} of {len(rest)} vertices are at the position of another one, such as "
            f"{first + 1} and {again + 1}: merge vertices by distance (in Blender: M, By Distance)"
        )


class _Body(NamedTuple):
    arrays: Arrays
    vertex_count: int
    """Vertices of the file."""
    welded_count: int
    """Vertices that were at the position of another one."""


def _read_body(data: bytes) -> _Body:
    if data.startswith(b"PK"):
        arrays = _read_frames(data)
    else:
        polygons = read_polygons(data)
        triangles = triangulate(polygons.positions, polygons.corners, polygons.sizes)
        arrays = {
            "positions": polygons.positions[None],
            "triangles": triangles,
            "times": np.zeros(1),
        }
    # Before the weld, which gives a triangle without an area a vertex twice.
    check_corners(arrays["triangles"])
    check_areas(_first_positions(arrays), arrays["triangles"])
    body = _weld_body(arrays)
    positions = _first_positions(body.arrays)
    check_edges(body.arrays["triangles"], len(positions))
    _check_extent(positions)
    return body


def _first_positions(arrays: Arrays) -> Floats:
    """Return the vertices of a body (N, 3): at rest if it is a skin, or in its first frame."""
    positions: Floats = arrays["rest"] if "rest" in arrays else arrays["positions"][0]
    return positions


def _weld_body(arrays: Arrays) -> _Body:
    """Weld the vertices of a body that are at equal positions at all times.

    Programs write a vertex for each face that has a normal or a texture coordinate of its own.
    """
    if "rest" in arrays:
        columns = np.column_stack([arrays["rest"], arrays["weights"]])
    else:
        positions = arrays["positions"]
        columns = positions.transpose(1, 0, 2).reshape(positions.shape[1], -1)
    same = weld(columns.astype(np.float64))
    count = len(columns)
    welded_count = count - len(same.vertices)
    if welded_count:
        arrays = dict(arrays)
        for name, axis in (("rest", 0), ("weights", 0), ("positions", 1)):
            if name in arrays:
                arrays[name] = np.take(arrays[name], same.vertices, axis=axis)
        arrays["triangles"] = same.targets[arrays["triangles"]]
    return _Body(arrays, count, welded_count)


def _read_frames(data: bytes) -> Arrays:
    """Return the arrays of a body in an NPZ file: frames, or a skin."""
    arrays = _read_arrays(data, _SKIN if "rest" in _array_names(data) else _FRAMES)
    _check_ascending(arrays["times"])
    count = len(_first_positions(arrays))
    stated = arrays["triangles"]
    triangles = stated.astype(np.int64)
    wrong = stated[(triangles != stated) | (triangles < 0) | (triangles >= count)]
    if wrong.size:
        raise UnfitFileError(f"triangles must be vertices, 0 to {count - 1}, and has {wrong[0]}")
    return {**arrays, "triangles": triangles}


def _read_start(data: bytes) -> Arrays:
    if data.startswith(b"PK"):
        return _read_arrays(data, {"positions": ("vertex", 3)})
    if not has_order(data):
        raise UnfitFileError(
            "must be an OBJ, PLY or NPZ file with the vertices of the sheet in their order, and an "
            "STL file has no such order"
        )
    return {"positions": read_polygons(data).positions}


def _check_extent(positions: Floats) -> None:
    """Raise UnfitFileError for a mesh whose size is that of another unit."""
    extent = float((positions.max(axis=0) - positions.min(axis=0)).max())
    if not SMALLEST <= extent <= LARGEST:
        raise UnfitFileError(
            f"must be {SMALLEST:g} to {LARGEST:g} m across, and is {extent:g} m{unit_hint(extent)}"
        )


# ---- Folders of frames --------------------------------------------------------------------------


def frames_of(files: Sequence[Path], scene: Scene, name: str) -> bytes:
    """Return a folder of mesh files, one a frame of the body that names it, as one NPZ file.

    Files that are no meshes are left out. Frames are in the order of the numbers in their names.

    Raises:
        UnfitFileError: A number is missing, or frames do not have the same faces.
    """
    files = _ordered_frames([file for file in files if file.suffix.lower() in MESH_SUFFIXES])
    rates = [
        body.frame_rate
        for body in scene.bodies.values()
        if isinstance(body, MeshBody) and body.file == name
    ]
    if not files or not rates or rates[0] is None:
        raise UnfitFileError(
            "must hold OBJ, PLY or STL files, one a frame, of a body with a frame_rate [1/s]"
        )
    frames = []
    for file in files:
        data = file.read_bytes()
        check_file(data)
        frames.append(read_polygons(data))
        _check_same_faces(frames[0], frames[-1], files[0], file)
    # All frames are cut as the first one: a triangle must not change from frame to frame.
    triangles = triangulate(frames[0].positions, frames[0].corners, frames[0].sizes)
    packed = io.BytesIO()
    np.savez(
        packed,
        positions=np.stack([frame.positions for frame in frames]),
        triangles=triangles,
        times=np.arange(len(files)) / rates[0],
    )
    return packed.getvalue()


def _check_same_faces(first: Polygons, frame: Polygons, first_file: Path, file: Path) -> None:
    if (
        first.positions.shape != frame.positions.shape
        or not np.array_equal(first.corners, frame.corners)
        or not np.array_equal(first.sizes, frame.sizes)
    ):
        raise UnfitFileError(
            f"{file.name} must have the vertices and faces of {first_file.name}, in the same order"
        )


def _ordered_frames(files: list[Path]) -> list[Path]:
    """Return the files of frames by the last number in their names; raise UnfitFileError.

    As text, `frame_10` comes before `frame_2`.
    """
    if len(files) < 2:
        return files
    numbered: dict[int, Path] = {}
    names: set[tuple[str, str]] = set()
    for file in files:
        match = re.fullmatch(r"(.*?)(\d+)(\D*)", file.stem)
        if match is None:
            raise UnfitFileError(
                f"frames must have numbers in their names, as frame_1.obj, and {file.name} has none"
            )
        names.add((match[1], match[3] + file.suffix.lower()))
        number = int(match[2])
        if number in numbered:
            raise UnfitFileError(
                f"frames must have different numbers, and {numbered[number].name} and {file.name} "
                f"have {number}"
            )
        numbered[number] = file
    if len(names) > 1:
        listed = ", ".join(sorted(before + "N" + after for before, after in names))
        raise UnfitFileError(f"must hold the frames of one body, and holds {listed}")
    first = min(numbered)
    for number in range(first, first + len(numbered)):
        if number not in numbered:
            raise UnfitFileError(
                f"frames must be numbered without gaps, and frame {number} is missing between "
                f"{first} and {max(numbered)}"
            )
    return [numbered[number] for number in sorted(numbered)]


# ---- Motions ------------------------------------------------------------------------------------


def _read_path(data: bytes) -> Arrays:
    if data.startswith(b"PK"):
        arrays = _read_arrays(data, {"time": ("time",), "move": ("time", 3), "turn": ("time", 3)})
        _check_ascending(arrays["time"])
        return arrays
    # utf-8-sig: spreadsheets write a byte order mark.
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        rule = f"must be text in UTF-8, or an NPZ file, and byte {error.start} is not UTF-8"
        raise UnfitFileError(rule) from error
    reader = csv.reader(io.StringIO(text, newline=""), skipinitialspace=True)
    try:
        header = next(reader, [])
        if tuple(cell.strip().lower() for cell in header) != PATH_COLUMNS:
            first = ",".join(header)[:80]
            rule = f"must begin with the line {','.join(PATH_COLUMNS)}, and begins with {first!r}"
            raise UnfitFileError(rule)
        # Rows of empty cells are what spreadsheets leave below a table.
        rows = [_path_row(cells, reader.line_num) for cells in reader if any(map(str.strip, cells))]
    except csv.Error as error:
        raise UnfitFileError(f"line {reader.line_num} must be CSV: {error}") from error
    table = np.array(rows).reshape(-1, len(PATH_COLUMNS))
    _check_ascending(table[:, 0])
    return {"time": table[:, 0], "move": table[:, 1:4], "turn": table[:, 4:]}


def _path_row(cells: list[str], line: int) -> list[float]:
    try:
        row = [float(cell) for cell in cells]
    except ValueError:
        row = []
    if len(row) != len(PATH_COLUMNS) or not np.isfinite(row).all():
        raise UnfitFileError(
            f"line {line} must be seven finite numbers [s, m, rad], and is {','.join(cells)[:80]!r}"
        )
    farthest = max(map(abs, row[1:4]))
    if farthest > FARTHEST:
        raise UnfitFileError(
            f"line {line} must move by at most {FARTHEST:g} m along each axis, and moves by "
            f"{farthest:g} m"
        )
    return row


def _check_ascending(times: Floats) -> None:
    if not len(times) or times[0] < 0 or not (np.diff(times) > 0).all():
        listed = ", ".join(f"{time:g}" for time in times[:8])
        raise UnfitFileError(
            f"times must be instants that ascend from 0 s or later, and are {listed or 'none'} [s]"
        )


# ---- NPZ ----------------------------------------------------------------------------------------


def _array_names(data: bytes) -> set[str]:
    """Return the names of the arrays of an NPZ file that has passed the gate."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name.removesuffix(".npy") for name in archive.namelist()}


def _read_arrays(data: bytes, shapes: _Shapes) -> Arrays:
    """Return arrays of an NPZ file; sides of their shapes with the same name must be equal."""
    missing = shapes.keys() - _array_names(data)
    if missing:
        listed = ", ".join(name for name in shapes if name in missing)
        raise UnfitFileError(f"must have {', '.join(shapes)}, and {listed} is missing")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in shapes}
    except (ValueError, OSError, zipfile.BadZipFile, zlib.error, EOFError) as error:
        raise UnfitFileError(f"must be an NPZ file of plain arrays: {error}") from error
    # A number in a shape stands for itself; a name stands for the first side that has it.
    sides: dict[str | int, int] = {3: 3, 4: 4}
    for name, values in arrays.items():
        _check_shape(name, values.shape, shapes[name], sides)
        _check_values(name, values)
    return arrays


def _check_shape(
    name: str, shape: tuple[int, ...], expected: tuple[str | int, ...], sides: dict[str | int, int]
) -> None:
    """Raise UnfitFileError for a shape that does not fit; add its sides to the known `sides`."""
    words = ", ".join(str(sides.get(side, side)) for side in expected)
    refusal = UnfitFileError(f"{name} must be ({words}), and is {shape}")
    if len(shape) != len(expected):
        raise refusal
    for side, extent in zip(expected, shape, strict=True):
        if extent == 0 or extent != sides.setdefault(side, extent):
            raise refusal


def _check_values(name: str, values: npt.NDArray[Any]) -> None:
    # The gate has let arrays of numbers through alone.
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        raise UnfitFileError(f"{name} must be finite numbers, and has {values[*wrong[0]]}")
    # All but times are lengths, or rotations and weights of order 1.
    is_length = values.dtype.kind == "f" and "time" not in name
    largest = float(np.abs(values).max()) if is_length else 0.0
    if largest > FARTHEST:
        raise UnfitFileError(f"{name} must be within {FARTHEST:g} m, and reaches {largest:g} m")
