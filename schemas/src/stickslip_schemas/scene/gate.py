"""The gate for files of scenes: their statements about themselves, before anything is decoded.

A small file can ask for much: 400 bytes of NPZ declare an array of 80 GB, and a mesh of two million
faces takes a parser 20 s. So counts, shapes and sizes are read from headers and from the structure
of lines, in one pass with constant memory, and a file beyond the limits is refused.
"""

import ast
import io
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.document import MAX_VERTICES
from stickslip_schemas.scene.errors import UnfitFileError
from stickslip_schemas.scene.mesh_files import (
    STL_HEADER_BYTES,
    is_binary_stl,
    is_ply,
    is_text_stl,
    obj_text,
    read_ply_header,
)
from stickslip_schemas.scene.parameters import Location
from stickslip_schemas.scene.plain_obj import Words
from stickslip_schemas.scene.polygons import MAX_CORNERS, Indices

MAX_FILE_BYTES = 16 * 2**20
"""Largest file of a scene, and largest sum of the arrays of an NPZ file [bytes]."""

MAX_SCENE_BYTES = 24 * 2**20
"""Largest sum of the files of a scene, or of their arrays if that is more [bytes].

To read so many takes about a second of CPU time."""

MAX_TRIANGLES = 2 * MAX_VERTICES
"""Triangles of one mesh: a closed surface has about two for each vertex."""

MAX_LINES = 1_000_000
"""Lines of a text file: a mesh at its limits has 600,000, with texture coordinates and normals."""

MAX_PATH_ROWS = 100_000
"""Rows of a path: 100 s at 1 kHz."""

MAX_SOUP_VERTICES = 3 * MAX_TRIANGLES
"""Vertices of a mesh before equal ones are welded: an STL file has three for each triangle."""

MAX_FACE_BYTES = 64 * 2**10
"""Longest face of an OBJ file [bytes]: 2,000 corners with texture coordinates and normals."""

COUNTED_BYTES = 2**20
"""Bytes of lines whose words are counted in one operation."""

MAX_ARRAYS = 16
"""Arrays of an NPZ file; a skin, which has the most, needs five."""

MAX_DIRECTORY_BYTES = 8 * 2**10
"""Largest directory of an NPZ file [bytes]: about 100 a member, and a comment."""

MAX_HEADER_BYTES = 1024
"""Longest header of an array of an NPZ file [bytes]; NumPy writes 118."""

_ROLES = (
    frozenset({"positions"}),
    frozenset({"rest", "weights", "bones"}),
    frozenset({"time", "move", "turn"}),
)
"""Arrays of which an NPZ file must have one set: a mesh or a start, a skin, a path."""

_ZIP = b"PK"
_END_OF_DIRECTORY = struct.Struct("<4s4H2LH")
_MAX_COMMENT_BYTES = 2**16 - 1
_ENCRYPTED = 0x1
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_NPY_MAGIC = b"\x93NUMPY"
_NUMBER = re.compile(r"[<>|=][fiu](1|2|4|8)")

_NEWLINES = (
    b"\n",
    b"\r",
    b"\x0b",
    b"\x0c",
    b"\x1c",
    b"\x1d",
    b"\x1e",
    b"\xc2\x85",
    b"\xe2\x80\xa8",
)
"""Everything at which `str.splitlines` begins a new line, in UTF-8."""

_VERTEX = re.compile(rb"^[ \t]*v[ \t]", re.MULTILINE)
_FACE = re.compile(rb"^[ \t]*f[ \t\x0b]([^\n]*)", re.MULTILINE)
_COMMENTS = re.compile(rb"#[^\n]*")
_FACET = re.compile(rb"\bendfacet\b", re.IGNORECASE)
_PATH_TABLE = re.compile(rb"(?:\xef\xbb\xbf)?[ \t]*\"?time\b", re.IGNORECASE)


Arrays = dict[str, npt.NDArray[Any]]
"""Arrays of a file, by name."""


@dataclass
class SceneBytes:
    """Counts the bytes of the files of a scene: each has a limit, and a scene may name hundreds."""

    read_file: Callable[[Location, bytes], Arrays]
    sizes: dict[bytes, int] = field(default_factory=dict)

    def read(self, location: Location, data: bytes) -> Arrays:
        """Return the arrays of a file at a location; raise UnfitFileError."""
        # The bytes are counted before they are read: a text takes longer than its arrays.
        self._count(data, len(data))
        arrays = self.read_file(location, data)
        self._count(data, sum(array.nbytes for array in arrays.values()))
        return arrays

    def _count(self, data: bytes, size: int) -> None:
        """Raise UnfitFileError if a file of `size` bytes makes the scene too large.

        A file that is counted again counts once, with its larger size.
        """
        self.sizes[data] = max(size, self.sizes.get(data, 0))
        total = sum(self.sizes.values())
        if total > MAX_SCENE_BYTES:
            raise UnfitFileError(
                f"must have at most {MAX_SCENE_BYTES} bytes together with the other files of the "
                f"scene, and with their arrays, and makes them {total}: make meshes coarser (in "
                "Blender: Decimate), or leave out frames that lie on the way between others"
            )


def check_file(data: bytes) -> None:
    """Raise UnfitFileError for a file that no scene can use, from its headers and line structure.

    A file that passes may still have wrong contents, but reading it takes bounded time and memory.
    """
    if len(data) > MAX_FILE_BYTES:
        raise UnfitFileError(f"must have at most {MAX_FILE_BYTES} bytes, and has {len(data)}")
    if data.startswith(_ZIP):
        _check_npz(data)
        return
    if is_binary_stl(data):
        count = int.from_bytes(data[STL_HEADER_BYTES - 4 : STL_HEADER_BYTES], "little")
        _check_triangles(count)
        return
    if is_ply(data):
        _check_ply(data)
        return
    lines = sum(data.count(newline) for newline in _NEWLINES)
    if lines > MAX_LINES:
        raise UnfitFileError(f"must have at most {MAX_LINES} lines, and has {lines}")
    if is_path_table(data):
        if lines > MAX_PATH_ROWS + 1:
            raise UnfitFileError(f"must have at most {MAX_PATH_ROWS} rows, and has {lines - 1}")
    elif is_text_stl(data):
        _check_triangles(sum(1 for _ in _FACET.finditer(data)))
    else:
        _check_obj(data)


def is_path_table(data: bytes) -> bool:
    """Return whether a file begins like the CSV file of a motion."""
    return _PATH_TABLE.match(data) is not None


def _check_triangles(count: int) -> None:
    if count > MAX_TRIANGLES:
        raise UnfitFileError(f"must have at most {MAX_TRIANGLES} triangles, and has {count}")


def _check_ply(data: bytes) -> None:
    """Check the counts that the header of a PLY file states."""
    header = read_ply_header(data)
    _check_triangles(header.count("face"))
    vertices = header.count("vertex")
    if vertices > MAX_SOUP_VERTICES:
        raise UnfitFileError(f"must have at most {MAX_SOUP_VERTICES} vertices, and has {vertices}")
    # Each value takes a byte or more, so other elements cannot ask for more than the file has.
    for element in header.elements:
        if element.count > len(data):
            raise UnfitFileError(
                f"must have at most {len(data)} elements {element.name}, the bytes of the file, "
                f"and its header states {element.count}"
            )


def _check_obj(data: bytes) -> None:
    """Count vertices and triangles of an OBJ file, up to their limits.

    A face of n corners has n - 2 triangles.
    """
    text = obj_text(data)
    # Equal vertices are welded later, so there may be more of them than a body may have.
    vertices = len(_VERTEX.findall(text))
    if vertices > MAX_SOUP_VERTICES:
        raise UnfitFileError(f"must have at most {MAX_SOUP_VERTICES} vertices, and has {vertices}")
    # A comment behind a face has no corners.
    faces = _FACE.findall(_COMMENTS.sub(b"", text) if b"#" in text else text)
    if len(faces) > MAX_TRIANGLES:
        raise UnfitFileError(f"must have at most {MAX_TRIANGLES} triangles, and has more")
    longest = max(map(len, faces), default=0)
    if longest > MAX_FACE_BYTES:
        raise UnfitFileError(
            f"a face must have at most {MAX_FACE_BYTES} bytes in its line, and one has {longest}"
        )
    corners = _count_words(faces)
    most = int(corners.max(initial=0))
    if most > MAX_CORNERS:
        raise UnfitFileError(f"a face must have at most {MAX_CORNERS} corners, and one has {most}")
    if int(corners.sum()) - 2 * len(corners) > MAX_TRIANGLES:
        raise UnfitFileError(f"must have at most {MAX_TRIANGLES} triangles, and has more")


def _count_words(lines: list[bytes]) -> Indices:
    """Return the number of words of each line, with bounded memory."""
    ends = np.cumsum(np.fromiter(map(len, lines), np.int64, len(lines)))
    total = int(ends[-1]) if len(lines) else 0
    bounds = np.searchsorted(ends, np.arange(0, total + COUNTED_BYTES, COUNTED_BYTES), side="right")
    counts = [Words(lines[begin:end]).counts for begin, end in pairwise(bounds) if begin < end]
    return np.concatenate([*counts, np.empty(0, np.int64)])


def _check_npz(data: bytes) -> None:
    """Check the members of an NPZ file, and read each header, without decoding an array."""
    try:
        _check_directory(data)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            _check_members(members)
            for member in members:
                _check_array(archive, member)
    except UnfitFileError:
        raise
    # A damaged archive fails in many ways: offsets before its beginning (ValueError), wrong
    # checksums, streams that end early.
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, struct.error) as error:
        raise UnfitFileError(f"must be an NPZ file: {error}") from error


def _check_directory(data: bytes) -> None:
    """Check the size of the directory, which `zipfile` reads as a whole.

    ZIP64 has other fields, for archives beyond 4 GB or 65,535 members, and is refused.
    """
    # The directory is at the end, before a comment of any length.
    tail = data[-(_END_OF_DIRECTORY.size + _MAX_COMMENT_BYTES) :]
    position = tail.rfind(b"PK\x05\x06")
    if position < 0 or position + _END_OF_DIRECTORY.size > len(tail):
        raise UnfitFileError("must be an NPZ file, and its directory is missing")
    _, _, _, _, count, size, _, _ = _END_OF_DIRECTORY.unpack_from(tail, position)
    if count > MAX_ARRAYS:
        raise UnfitFileError(f"must have at most {MAX_ARRAYS} arrays, and has {count}")
    if size > MAX_DIRECTORY_BYTES:
        raise UnfitFileError(
            f"must have a directory of at most {MAX_DIRECTORY_BYTES} bytes, and it has {size}"
        )


def _check_members(members: list[zipfile.ZipInfo]) -> None:
    """Check the names, sizes and compressions that the directory states."""
    if len(members) > MAX_ARRAYS:
        raise UnfitFileError(f"must have at most {MAX_ARRAYS} arrays, and has {len(members)}")
    names = [member.filename for member in members]
    # Names decide which role a file can have.
    arrays = {name.removesuffix(".npy") for name in names if name.endswith(".npy")}
    if not any(role <= arrays for role in _ROLES):
        listed = ", ".join(sorted(arrays))[:200] or "none"
        raise UnfitFileError(
            "must have the arrays of a mesh or a start (positions), of a skin (rest, weights, "
            f"bones) or of a path (time, move, turn), and has {listed}"
        )
    if len(arrays) != len(names):
        raise UnfitFileError("must have only arrays (.npy), each once")
    # Only what `numpy.savez` writes is read.
    for member in members:
        if member.flag_bits & _ENCRYPTED:
            raise UnfitFileError(f"must not be encrypted, and {member.filename} is")
        if member.compress_type not in _COMPRESSIONS:
            raise UnfitFileError(
                "must be stored or compressed with deflate, as numpy.savez does, and "
                f"{member.filename} has compression {member.compress_type}"
            )
    # A compressed file may state any size, and is not unpacked to find out.
    unpacked = sum(member.file_size for member in members)
    if unpacked > MAX_FILE_BYTES:
        raise UnfitFileError(
            f"must have at most {MAX_FILE_BYTES} bytes when unpacked, and has {unpacked}"
        )


def _check_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> None:
    """Check that the header of an array states numbers of a shape that fills the member exactly."""
    name = member.filename.removesuffix(".npy")
    with archive.open(member) as file:
        magic = file.read(8)
        if not magic.startswith(_NPY_MAGIC) or len(magic) < 8:
            raise UnfitFileError(f"{name} must be an array in NumPy's format")
        length_format = "<H" if magic[6] == 1 else "<L"
        length_bytes = file.read(struct.calcsize(length_format))
        (length,) = struct.unpack(length_format, length_bytes)
        if length > MAX_HEADER_BYTES:
            raise UnfitFileError(
                f"{name} must have a header of at most {MAX_HEADER_BYTES} bytes, and it has "
                f"{length}"
            )
        header = file.read(length)
    item_bytes, shape = _read_header(name, header)
    # A header that states more than the member has would ask for memory.
    expected = len(magic) + len(length_bytes) + length + item_bytes * prod(shape)
    if expected != member.file_size:
        raise UnfitFileError(
            f"{name} must have the {expected} bytes of its shape {shape}, and has "
            f"{member.file_size}"
        )


def _read_header(name: str, header: bytes) -> tuple[int, tuple[int, ...]]:
    """Return the bytes of a number, and the shape, of an array."""
    try:
        fields = ast.literal_eval(header.decode("latin-1").strip())
    # A thousand brackets exhaust the parser of Python in one of these ways.
    except (ValueError, SyntaxError, MemoryError, RecursionError) as error:
        raise UnfitFileError(f"{name} must have a header in NumPy's format") from error
    is_complete = isinstance(fields, dict) and fields.keys() == {"descr", "fortran_order", "shape"}
    if not is_complete or not isinstance(fields["fortran_order"], bool):
        raise UnfitFileError(f"{name} must have a header in NumPy's format")
    number = fields["descr"]
    match = _NUMBER.fullmatch(number) if isinstance(number, str) else None
    if match is None:
        raise UnfitFileError(f"{name} must be numbers, and its type is {str(number)[:40]}")
    shape = fields["shape"]
    if not isinstance(shape, tuple) or not all(_is_side(side) for side in shape):
        raise UnfitFileError(
            f"{name} must have a shape of whole numbers from 0 to {MAX_FILE_BYTES}, and it is "
            f"{shape!s:.60}"
        )
    return int(match[1]), shape


def _is_side(side: object) -> bool:
    """Return whether a value can be a side of a shape: True and False are ints in Python, too."""
    return type(side) is int and 0 <= side <= MAX_FILE_BYTES
