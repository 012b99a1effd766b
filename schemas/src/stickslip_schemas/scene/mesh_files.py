"""Mesh files of other programs: OBJ, STL and PLY, read as polygons.

The readers are ours, and not of a mesh library, for three reasons (tried with trimesh 5.2).
Libraries fan every polygon, so concave faces come out wrong. They build all triangles before
anybody can count them: one face of 4 million corners took 300 MB. And they renumber vertices, while
frames of an animation and the start of a sheet need the order of the file.

The gate (`gate.check_file`) has counted vertices and faces before a reader begins.
"""

import codecs
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, NoReturn

import numpy as np

from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.plain_obj import read_tables
from stickslip_schemas.scene.polygons import Floats, Indices

FARTHEST = 100.0
"""Largest coordinate in a file [m]."""

MAX_LIST_ITEMS = 100_000
"""Longest list of a PLY file that is skipped."""

STL_HEADER_BYTES = 84
"""The text of a binary STL file, and its number of triangles."""

STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""A triangle of a binary STL file."""

_PLY = re.compile(rb"ply[ \t]*\r?\n")
_PLY_HEADER_BYTES = 2**14
_PLY_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}

_CONTINUED = b"\x0b"
"""Stands for a line break after a backslash: `split` ignores it, and line numbers count it."""
_OBJ_LINE = re.compile(rb"^[ \t]*(vt|v|f)(?![^ \t\x0b\n])([^\n]*)", re.MULTILINE)
_STL_VERTEX = re.compile(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


class Polygons(NamedTuple):
    """Faces of a file, and the vertices that they name."""

    positions: Floats
    """(N, 3) [m]."""
    corners: Indices
    """(C,): the vertices of all faces, one face after the other."""
    sizes: Indices
    """(F,): number of corners of each face."""
    pattern: Floats | None = None
    """(N, 2): texture coordinates of the vertices [m]; None if they were not asked for."""


def is_binary_stl(data: bytes) -> bool:
    """Return whether a file has the size that the number of triangles in its header gives.

    Some programs begin the text of a binary file with `solid`, so the text does not tell.
    """
    if len(data) < STL_HEADER_BYTES:
        return False
    count = int.from_bytes(data[STL_HEADER_BYTES - 4 : STL_HEADER_BYTES], "little")
    return len(data) == STL_HEADER_BYTES + count * STL_TRIANGLE.itemsize


def is_text_stl(data: bytes) -> bool:
    """Return whether a file begins like an STL file in text."""
    return re.match(rb"\s*solid\b[^\n]*\n\s*(facet|endsolid)\b", data, re.IGNORECASE) is not None


def is_ply(data: bytes) -> bool:
    """Return whether a file begins like a PLY file."""
    return _PLY.match(data) is not None


def has_order(data: bytes) -> bool:
    """Return whether the vertices of a mesh file have an order that other files can share.

    An STL file lists three vertices for each triangle.
    """
    return not (is_binary_stl(data) or is_text_stl(data))


def read_polygons(data: bytes, *, with_pattern: bool = False) -> Polygons:
    """Return the polygons of an OBJ, STL or PLY file.

    Only an OBJ file has a flat pattern. Texture coordinates are ignored unless `with_pattern` asks
    for them, so seams and missing coordinates of a body do no harm.

    Raises:
        UnfitFileError: The file is damaged, or no mesh.
    """
    if with_pattern and (is_ply(data) or not has_order(data)):
        raise UnfitFileError(
            "must be an OBJ file, whose texture coordinates (vt) are the flat pattern [m]"
        )
    if is_ply(data):
        polygons = _read_ply(data)
    elif is_binary_stl(data):
        polygons = _read_binary_stl(data)
    elif is_text_stl(data):
        polygons = _read_text_stl(data)
    else:
        polygons = _read_obj(data, with_pattern=with_pattern)
    _check_polygons(polygons)
    return polygons


def _check_polygons(polygons: Polygons) -> None:
    """Raise UnfitFileError for positions that are no finite lengths, or unknown vertices."""
    if not len(polygons.sizes) and not len(polygons.positions):
        raise UnfitFileError(
            "must have faces, and has none, nor vertices: is it a mesh, and not a page of a web "
            "server or a pointer of Git LFS?"
        )
    if not len(polygons.sizes):
        raise UnfitFileError("must have faces, and has none")
    far = ~(np.abs(polygons.positions) <= FARTHEST).all(axis=1)
    if far.any():
        vertex = int(np.argmax(far))
        position = ", ".join(f"{value:g}" for value in polygons.positions[vertex])
        raise UnfitFileError(
            f"vertices must be within {FARTHEST:g} m, and vertex {vertex} is at ({position}) m"
        )
    count = len(polygons.positions)
    unknown = (polygons.corners < 0) | (polygons.corners >= count)
    if unknown.any():
        corner = polygons.corners[int(np.argmax(unknown))]
        raise UnfitFileError(f"faces must name vertices 0 to {count - 1}, and one names {corner}")


# ---- OBJ --------------------------------------------------------------------------------------


def obj_text(data: bytes) -> bytes:
    """Return an OBJ file with one sort of line break, and with continued lines joined.

    Names of objects may be in any encoding: only lines of numbers are read.
    """
    for mark, encoding in ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16")):
        if data.startswith(mark):
            try:
                data = data.decode(encoding).encode()
            except UnicodeDecodeError as error:
                raise UnfitFileError(
                    f"must be text, or an NPZ file, and byte {error.start} is not of its encoding"
                ) from error
    data = data.removeprefix(codecs.BOM_UTF8)
    if b"\0" in data[:1024]:
        raise UnfitFileError("must be an OBJ, STL, PLY or NPZ file, and is none of them")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return data.replace(b"\\\n", _CONTINUED)


def _read_obj(data: bytes, *, with_pattern: bool) -> Polygons:
    text = obj_text(data)
    tables = read_tables(text, with_pattern=with_pattern, farthest=FARTHEST)
    if tables is None:
        return _read_obj_lines(text, with_pattern=with_pattern)
    if not with_pattern:
        return Polygons(tables.positions, tables.corners, tables.sizes)
    pattern = np.full((len(tables.positions), 2), np.nan)
    contradiction = _fill_pattern(pattern, tables.texture, tables.corners, tables.corner_textures)
    # Only lines can name the one with the second texture coordinate.
    if contradiction is not None:
        return _read_obj_lines(text, with_pattern=True)
    return Polygons(tables.positions, tables.corners, tables.sizes, pattern)


def _read_obj_lines(text: bytes, *, with_pattern: bool) -> Polygons:
    positions: list[list[float]] = []
    texture: list[list[float]] = []
    corners: list[int] = []
    corner_textures: list[int] = []
    sizes: list[int] = []
    face_lines: list[re.Match[bytes]] = []
    for line in _OBJ_LINE.finditer(text):
        keyword = line[1]
        words = line[2].split(b"#")[0].split()
        try:
            if keyword == b"v":
                positions.append(_numbers(words, 3))
            elif keyword == b"vt":
                # Three numbers are a volume texture; the first two are the pattern.
                if with_pattern:
                    texture.append(_numbers(words, 2))
            else:
                sizes.append(len(words))
                face_lines.append(line)
                if len(words) < 3:
                    raise ValueError
                corners += [_index(word.split(b"/")[0], len(positions)) for word in words]
                if with_pattern:
                    corner_textures += [_texture_index(word, len(texture)) for word in words]
        except ValueError as error:
            _refuse_line(text, line, error)
    pattern = None
    if with_pattern and sizes:
        pattern = np.full((len(positions), 2), np.nan)
        wrong_corner = _fill_pattern(
            pattern,
            np.array(texture),
            np.array(corners, dtype=np.int64),
            np.array(corner_textures, dtype=np.int64),
        )
        if wrong_corner is not None:
            face = int(np.searchsorted(np.cumsum(sizes), wrong_corner, side="right"))
            raise UnfitFileError(
                f"line {_line_number(text, face_lines[face])}: a vertex must have one texture "
                f"coordinate, and {corners[wrong_corner] + 1} has two: unwrap the sheet without "
                "seams, for they cut the flat pattern"
            )
    return Polygons(
        np.array(positions).reshape(-1, 3),
        np.array(corners, dtype=np.int64),
        np.array(sizes, dtype=np.int64),
        pattern,
    )


def _line_number(text: bytes, line: re.Match[bytes]) -> int:
    return 1 + sum(text.count(newline, 0, line.start()) for newline in (b"\n", _CONTINUED))


def _refuse_line(text: bytes, line: re.Match[bytes], error: ValueError) -> NoReturn:
    number = _line_number(text, line)
    text_of_line = line[0].decode("utf-8", "replace").strip()[:80]
    rule = f"must be a vertex within {FARTHEST:g} m or a face of its vertices"
    raise UnfitFileError(f"line {number} {rule}, and is {text_of_line!r}") from error


def _numbers(words: list[bytes], count: int) -> list[float]:
    """Return the first numbers of a line; raise ValueError if one is missing or out of range."""
    numbers = [float(word) for word in words[:count]]
    # A comparison with NaN is false, so NaN is refused, too.
    if len(numbers) != count or not all(abs(number) <= FARTHEST for number in numbers):
        raise ValueError
    return numbers


def _index(word: bytes, count: int) -> int:
    """Return an index from 0: an OBJ file counts from 1, or from -1 back from the last one."""
    number = int(word)
    if number == 0 or abs(number) > count:
        raise ValueError
    return number - 1 if number > 0 else count + number


def _texture_index(word: bytes, count: int) -> int:
    """Return the texture coordinate of a corner `v/vt/vn`; -1 if it has none."""
    _, *rest = word.split(b"/")
    return _index(rest[0], count) if rest and rest[0] else -1


def _fill_pattern(
    pattern: Floats, texture: Floats, vertices: Indices, indices: Indices
) -> int | None:
    """Write the flat pattern (N, 2) of a file; return a corner that contradicts another one.

    `vertices` and `indices` (C,) are the vertex and the texture coordinate of each corner, -1
    without one. Raises UnfitFileError if a vertex has no texture coordinate.
    """
    with_texture = np.flatnonzero(indices >= 0)
    if len(with_texture):
        coordinates = texture[indices[with_texture]]
        # The first corner of a vertex counts, so that the message names the line of a later one.
        pattern[vertices[with_texture][::-1]] = coordinates[::-1]
        # Coordinates are compared, and not their numbers: some programs write them for each face.
        differs = (pattern[vertices[with_texture]] != coordinates).any(axis=1)
        if differs.any():
            return int(with_texture[int(np.argmax(differs))])
    missing = np.isnan(pattern).any(axis=1)
    if missing.any():
        raise UnfitFileError(
            "must have texture coordinates (vt), one for each vertex: the flat pattern [m]; "
            f"vertex {int(np.argmax(missing)) + 1} has none: unwrap the sheet, and export UVs"
        )
    return None


# ---- STL --------------------------------------------------------------------------------------


def _read_binary_stl(data: bytes) -> Polygons:
    triangles = np.frombuffer(data, STL_TRIANGLE, offset=STL_HEADER_BYTES)
    return _soup(triangles["corners"].astype(np.float64).reshape(-1, 3))


def _read_text_stl(data: bytes) -> Polygons:
    vertices = _STL_VERTEX.findall(data)
    try:
        # Through single precision, as in a binary file.
        positions = np.array(vertices, dtype=np.float32).astype(np.float64).reshape(-1, 3)
    except ValueError as error:
        word = next(word for row in vertices for word in row if not _is_number(word))
        text_of_word = word.decode("utf-8", "replace")[:80]
        rule = f"vertices of an STL file must be three numbers, and one has {text_of_word!r}"
        raise UnfitFileError(rule) from error
    facets = len(re.findall(rb"\bendfacet\b", data, re.IGNORECASE))
    if len(positions) != 3 * facets:
        raise UnfitFileError(
            f"an STL file must have three vertices a facet, and has {len(positions)} vertices and "
            f"{facets} facets"
        )
    return _soup(positions)


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _soup(positions: Floats) -> Polygons:
    """Return triangles that share no vertices: an STL file has no others."""
    count = len(positions) // 3
    return Polygons(positions, np.arange(3 * count), np.full(count, 3))


# ---- PLY --------------------------------------------------------------------------------------


class _Property(NamedTuple):
    name: str
    dtype: str
    """Of the value, or of the items of a list."""
    count_dtype: str | None
    """Of the number of items of a list; None of a single value."""


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: list[_Property]


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """The header of a PLY file."""

    byte_order: str
    """`<` or `>`; empty in text."""
    elements: list[_Element]
    end: int
    """Offset of the first value [bytes]."""

    def count(self, name: str) -> int:
        """Return how many elements of a name the file states."""
        return sum(element.count for element in self.elements if element.name == name)


def read_ply_header(data: bytes) -> PlyHeader:
    """Return the header of a PLY file; raise UnfitFileError."""
    end = re.search(rb"\nend_header[ \t]*\r?\n", data[:_PLY_HEADER_BYTES])
    if end is None:
        raise UnfitFileError(
            f"a PLY file must have end_header within {_PLY_HEADER_BYTES} bytes, and has none"
        )
    byte_order: str | None = None
    elements: list[_Element] = []
    for line in data[: end.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        match words:
            case ["format", name, *_] if name in _PLY_FORMATS:
                byte_order = _PLY_FORMATS[name]
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count_type, item_type, name] if (
                elements and {count_type, item_type} <= _PLY_TYPES.keys()
            ):
                elements[-1].properties.append(
                    _Property(name, _PLY_TYPES[item_type], _PLY_TYPES[count_type])
                )
            case ["property", value_type, name] if elements and value_type in _PLY_TYPES:
                elements[-1].properties.append(_Property(name, _PLY_TYPES[value_type], None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise UnfitFileError(
                    f"the header of a PLY file must not have the line {line!r:.80}"
                )
    if byte_order is None:
        raise UnfitFileError("a PLY file must have a format: ascii or binary")
    return PlyHeader(byte_order, elements, end.end())


def _read_ply(data: bytes) -> Polygons:
    header = read_ply_header(data)
    columns: dict[str, dict[str, Any]] = {}
    try:
        if header.byte_order:
            offset = header.end
            for element in header.elements:
                columns[element.name], offset = _binary_element(data, element, header, offset)
        else:
            lines = iter(data[header.end :].split(b"\n"))
            for element in header.elements:
                columns[element.name] = _text_element(lines, element)
    # A file that is cut off ends in the middle of a number, a list or an element.
    except (ValueError, IndexError, StopIteration, struct.error) as error:
        raise UnfitFileError(
            "a PLY file must have the elements of its header, and this one ends early or has "
            "other values"
        ) from error
    vertices = columns.get("vertex", {})
    faces = columns.get("face", {})
    indices = faces.get("vertex_indices", faces.get("vertex_index"))
    if not {"x", "y", "z"} <= vertices.keys() or indices is None:
        raise UnfitFileError(
            "a PLY file must have vertices with x, y and z, and faces with a list vertex_indices"
        )
    positions = np.stack([np.asarray(vertices[axis], np.float64) for axis in "xyz"], axis=1)
    sizes = np.array([len(face) for face in indices], dtype=np.int64)
    corners = np.concatenate([*indices, []]).astype(np.int64)
    return Polygons(positions, corners, sizes)


def _binary_element(
    data: bytes, element: _Element, header: PlyHeader, offset: int
) -> tuple[dict[str, Any], int]:
    """Return the values of an element by property, and the offset of its end [bytes]."""
    order = header.byte_order
    if all(entry.count_dtype is None for entry in element.properties):
        row = np.dtype([(entry.name, order + entry.dtype) for entry in element.properties])
        table = np.frombuffer(data, row, element.count, offset)
        columns = {name: table[name] for name in row.names or ()}
        return columns, offset + element.count * row.itemsize
    # Lists have any length, so rows are read one by one. The gate has limited their number.
    lists: dict[str, list[Any]] = {entry.name: [] for entry in element.properties}
    for _ in range(element.count):
        for entry in element.properties:
            count = 1
            if entry.count_dtype is not None:
                counter = np.dtype(order + entry.count_dtype)
                count = int(np.frombuffer(data, counter, 1, offset)[0])
                offset += counter.itemsize
                if not 0 <= count <= MAX_LIST_ITEMS:
                    raise ValueError
            items = np.dtype(order + entry.dtype)
            lists[entry.name].append(np.frombuffer(data, items, count, offset))
            offset += count * items.itemsize
    return lists, offset


def _text_element(lines: Iterator[bytes], element: _Element) -> dict[str, Any]:
    """Return the values of an element of a PLY file in text, by property."""
    columns: dict[str, list[Any]] = {entry.name: [] for entry in element.properties}
    for _ in range(element.count):
        words = next(lines).split()
        position = 0
        for entry in element.properties:
            if entry.count_dtype is None:
                columns[entry.name].append(float(words[position]))
                position += 1
                continue
            count = int(words[position])
            if not 0 <= count <= min(MAX_LIST_ITEMS, len(words) - position - 1):
                raise ValueError
            items = words[position + 1 : position + 1 + count]
            columns[entry.name].append(np.array(items, dtype=np.float64))
            position += 1 + count
    return dict(columns)
