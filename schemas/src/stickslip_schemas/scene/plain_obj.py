"""OBJ files that are plain, read as tables: most files are, and a line at a time is slow.

Plain means that vertices come before faces, all corners name the same kinds of indices, and all
indices count from the first vertex. Other files, and wrong ones, are read line by line
(`mesh_files`), so that messages can name the line.
"""

import re
import warnings
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.polygons import Floats, Indices

_VERTEX = re.compile(rb"^v[ \t]([^\n]*)", re.MULTILINE)
_TEXTURE = re.compile(rb"^vt[ \t]([^\n]*)", re.MULTILINE)
_FACE = re.compile(rb"^f[ \t]([^\n]*)", re.MULTILINE)
_UNUSUAL = (b"#", b"\\", b"\x0b", b"\n ", b"\n\t", b"\nv\n", b"\nvt\n", b"\nf\n")
"""What only other styles have: comments behind numbers, continued, indented and empty lines."""

_COMMENT_LINES = re.compile(rb"^#[^\n]*", re.MULTILINE)


class ObjTables(NamedTuple):
    """The numbers of a plain OBJ file."""

    positions: Floats
    """(N, 3) [m]."""
    texture: Floats
    """(M, 2): texture coordinates [m]; (0, 2) if they were not asked for."""
    corners: Indices
    """(C,): the vertices of all faces, one face after the other."""
    corner_textures: Indices
    """(C,): their texture coordinates; -1 without one. Empty if they were not asked for."""
    sizes: Indices
    """(F,): number of corners of each face."""


def read_tables(text: bytes, *, with_pattern: bool, farthest: float) -> ObjTables | None:
    """Return the numbers of an OBJ file; None if it is not plain.

    `text` has one sort of line break, and `farthest` is the largest coordinate [m].
    """
    text = b"\n" + (_COMMENT_LINES.sub(b"", text) if b"#" in text else text) + b"\n"
    last_vertex = max(text.rfind(b"\nv "), text.rfind(b"\nvt "), text.rfind(b"\nv\t"))
    first_face = _FACE.search(text)
    is_unusual = any(mark in text for mark in _UNUSUAL)
    if is_unusual or first_face is None or first_face.start() < last_vertex:
        return None
    positions = _coordinates(_VERTEX.findall(text), 3, farthest)
    texture: Floats | None = np.empty((0, 2))
    if with_pattern:
        texture = _coordinates(_TEXTURE.findall(text), 2, farthest)
    faces = Words(_FACE.findall(text))
    indices = _indices(faces)
    if positions is None or texture is None or indices is None:
        return None
    vertices = indices[:, 0] - 1
    textures = np.empty(0, np.int64)
    if with_pattern:
        has_textures = indices.shape[1] > 1
        textures = indices[:, 1] - 1 if has_textures else np.full(len(vertices), -1)
        if has_textures and not _are_within(textures, len(texture)):
            return None
    if not _are_within(vertices, len(positions)):
        return None
    return ObjTables(positions, texture, vertices, textures, faces.counts)


def _are_within(indices: Indices, count: int) -> bool:
    return bool(indices.min() >= 0 and indices.max() < count)


class Words:
    """The words of lines, counted without a Python object for each."""

    def __init__(self, lines: list[bytes]) -> None:
        self.text = b"\n".join(lines)
        letters = np.frombuffer(b" " + self.text, np.uint8)
        is_blank = letters <= ord(" ")
        self.begins = np.flatnonzero(is_blank[:-1] & ~is_blank[1:])
        """Where each word begins in the text."""
        line_ends = np.flatnonzero(letters == ord("\n"))
        before = np.searchsorted(self.begins, [0, *line_ends, len(self.text)])
        self.counts: Indices = np.diff(before)
        """Number of words in each line."""

    def marks(self, mark: bytes) -> Indices:
        """Return how often a character stands in each word."""
        places = np.flatnonzero(np.frombuffer(self.text, np.uint8) == ord(mark))
        before = np.searchsorted(places, np.append(self.begins, len(self.text)))
        return np.diff(before)


def _parsed(text: bytes, dtype: type) -> npt.NDArray[Any] | None:
    """Return the numbers of a text with blanks between them; None if it has others."""
    with warnings.catch_warnings():
        # NumPy warns, and ends early, at the first word that is no number.
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, dtype, sep=" ")
        except (DeprecationWarning, ValueError):
            return None


def _coordinates(lines: list[bytes], count: int, farthest: float) -> Floats | None:
    """Return the first numbers of lines (N, count); None if a line has too few or others."""
    words = Words(lines)
    if not len(words.counts) or words.counts.min() < count or np.ptp(words.counts):
        return None
    numbers = _parsed(words.text, np.float64)
    if numbers is None or len(numbers) != len(words.begins):
        return None
    table = numbers.reshape(len(lines), -1)[:, :count]
    # A comparison with NaN is false, so NaN is refused, too.
    return np.ascontiguousarray(table) if (np.abs(table) <= farthest).all() else None


def _indices(faces: Words) -> Indices | None:
    """Return the indices of corners, (C, 1) or (C, 2 or 3); None if they are of several kinds."""
    if faces.counts.min() < 3:
        return None
    slashes = faces.marks(b"/")
    if np.ptp(slashes):
        return None
    # `7//3` has a normal and no texture coordinate.
    separator = b"//" if b"//" in faces.text else b"/"
    column_count = 1 + int(slashes[0]) // len(separator)
    numbers = _parsed(faces.text.replace(separator, b" "), np.int64)
    if numbers is None or len(numbers) != column_count * len(slashes):
        return None
    indices = numbers.reshape(-1, column_count)
    return indices[:, :1] if separator == b"//" else indices
