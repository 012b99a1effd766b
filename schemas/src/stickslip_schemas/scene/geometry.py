"""Geometry of triangles: which cross, and which points lie on them.

Candidates come from two trees of boxes, so that the cost grows with the number of triangles, not
with its square.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

CANDIDATES_AT_ONCE = 100_000
"""Candidates that are compared in one operation: bounds the memory to about 100 MB."""

MORTON_BITS = 10
"""Bits of each coordinate of a Morton code: boxes that are neighbours in it are near each other."""


@dataclass(frozen=True, eq=False, slots=True)
class TriangleMesh:
    """Triangles of one sheet or body."""

    vertices: Floats
    """(V, 3) [m]"""

    triangles: Integers
    """(T, 3)"""

    @property
    def corners(self) -> Floats:
        """(T, 3, 3) [m]: the positions of the corners of each triangle."""
        return self.vertices[self.triangles]


@dataclass(frozen=True, slots=True)
class Crossing:
    """Two triangles that cross."""

    first: int
    second: int
    point: tuple[float, float, float]
    """The middle of the first triangle [m]."""


@dataclass(frozen=True, slots=True)
class Touch:
    """A vertex that lies on a triangle."""

    vertex: int
    triangle: int
    distance: float
    """[m]"""


# ---- Candidates


class BoxTree:
    """A binary tree of boxes, level by level, whose leaves are given boxes."""

    def __init__(self, low: Floats, high: Floats) -> None:
        """Build the tree over N boxes with corners `low` and `high`, (N, 3) [m] each."""
        count = len(low)
        self.depth = max(count - 1, 0).bit_length()
        self.order = np.argsort(_morton_codes(0.5 * (low + high)), kind="stable")
        # Leaves without a box are empty: they overlap nothing.
        leaves = 2**self.depth
        lowest = np.full((leaves, 3), np.inf)
        highest = np.full((leaves, 3), -np.inf)
        lowest[:count] = low[self.order]
        highest[:count] = high[self.order]
        self.levels = [(lowest, highest)]
        for _ in range(self.depth):
            lowest = lowest.reshape(-1, 2, 3).min(axis=1)
            highest = highest.reshape(-1, 2, 3).max(axis=1)
            self.levels.append((lowest, highest))
        self.levels.reverse()


def _morton_codes(points: Floats) -> Integers:
    """Return codes (N,) in whose order points (N, 3) [m] follow a space-filling curve."""
    low = points.min(axis=0)
    extent = max(float((points.max(axis=0) - low).max()), 1e-300)
    cells = ((points - low) / extent * (2**MORTON_BITS - 1)).astype(np.int64)
    codes = np.zeros(len(points), np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


def overlapping_boxes(one: BoxTree, other: BoxTree) -> Iterator[tuple[Integers, Integers]]:
    """Yield the pairs of boxes that overlap, as numbers of boxes, in batches."""
    start = (np.zeros(1, np.int64), np.zeros(1, np.int64), 0, 0)
    waiting = [start]
    while waiting:
        i, j, level_one, level_other = waiting.pop()
        low_one, high_one = one.levels[level_one]
        low_other, high_other = other.levels[level_other]
        overlaps = (low_one[i] <= high_other[j]) & (low_other[j] <= high_one[i])
        kept = overlaps.all(axis=1)
        i = i[kept]
        j = j[kept]
        if not len(i):
            continue
        if level_one == one.depth and level_other == other.depth:
            yield one.order[i], other.order[j]
            continue
        # Both trees are descended by one level, as long as they have another.
        if level_one < one.depth:
            i, j = np.repeat(2 * i, 2) + np.tile([0, 1], len(i)), np.repeat(j, 2)
            level_one += 1
        if level_other < other.depth:
            j, i = np.repeat(2 * j, 2) + np.tile([0, 1], len(j)), np.repeat(i, 2)
            level_other += 1
        for begin in range(0, len(i), CANDIDATES_AT_ONCE):
            end = begin + CANDIDATES_AT_ONCE
            waiting.append((i[begin:end], j[begin:end], level_one, level_other))


def _tree_of(mesh: TriangleMesh, margin: float = 0.0) -> BoxTree:
    corners = mesh.corners
    return BoxTree(corners.min(axis=1) - margin, corners.max(axis=1) + margin)


# ---- Crossings


def find_crossing(one: TriangleMesh, other: TriangleMesh) -> Crossing | None:
    """Return two triangles of two meshes that cross; None if none do."""
    corners_one = one.corners
    corners_other = other.corners
    for i, j in overlapping_boxes(_tree_of(one), _tree_of(other)):
        crosses = _cross(corners_one[i], corners_other[j])
        if crosses.any():
            return _crossing(i, j, crosses, corners_one)
    return None


def find_self_crossing(mesh: TriangleMesh) -> Crossing | None:
    """Return two triangles of one mesh that cross and share no vertex; None if none do."""
    corners = mesh.corners
    tree = _tree_of(mesh)
    for i, j in overlapping_boxes(tree, tree):
        # Neighbours meet at the vertices that they share, which is no crossing.
        pairs = mesh.triangles[i][:, :, None] == mesh.triangles[j][:, None, :]
        apart = (i < j) & ~pairs.any(axis=(1, 2))
        i, j = i[apart], j[apart]
        crosses = _cross(corners[i], corners[j])
        if crosses.any():
            return _crossing(i, j, crosses, corners)
    return None


def _crossing(
    i: Integers, j: Integers, crosses: npt.NDArray[np.bool_], corners: Floats
) -> Crossing:
    number = int(np.argmax(crosses))
    x, y, z = corners[i[number]].mean(axis=0).tolist()
    return Crossing(int(i[number]), int(j[number]), (x, y, z))


def _cross(one: Floats, other: Floats) -> npt.NDArray[np.bool_]:
    """Return whether an edge of either triangle pierces the other: (N,), of corners (N, 3, 3)."""
    pierces = np.zeros(len(one), dtype=bool)
    for triangle, cutter in ((one, other), (other, one)):
        for corner in range(3):
            begin = cutter[:, corner]
            end = cutter[:, (corner + 1) % 3]
            pierces |= _pierces(begin, end, triangle)
    return pierces


def _pierces(begin: Floats, end: Floats, triangle: Floats) -> npt.NDArray[np.bool_]:
    """Return whether segments (N, 3) go through triangles (N, 3, 3), or through their borders."""
    a, b, c = triangle[:, 0], triangle[:, 1], triangle[:, 2]
    normal = np.cross(b - a, c - a)
    side_begin = _dot(begin - a, normal)
    side_end = _dot(end - a, normal)
    # The line passes on the same side of all three edges if it passes through the triangle.
    way = end - begin
    volumes = np.stack(
        [
            _dot(way, np.cross(a - begin, b - begin)),
            _dot(way, np.cross(b - begin, c - begin)),
            _dot(way, np.cross(c - begin, a - begin)),
        ]
    )
    inside = (volumes >= 0.0).all(axis=0) | (volumes <= 0.0).all(axis=0)
    return inside & (side_begin * side_end < 0.0)


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", a, b))


# ---- Distances


def find_touch(points: Floats, mesh: TriangleMesh, reach: float) -> Touch | None:
    """Return a vertex of points (V, 3) that is nearer to a triangle than `reach` [m].

    None if none is.
    """
    corners = mesh.corners
    tree_of_points = BoxTree(points - reach, points + reach)
    for i, j in overlapping_boxes(tree_of_points, _tree_of(mesh)):
        distances = _distances(points[i], corners[j])
        near = distances < reach
        if near.any():
            number = int(np.argmax(near))
            return Touch(int(i[number]), int(j[number]), float(distances[number]))
    return None


def _distances(points: Floats, triangles: Floats) -> Floats:
    """Return the distances (N,) [m] of points (N, 3) from triangles (N, 3, 3)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    length = np.sqrt(_dot(normal, normal))
    height = np.abs(_dot(points - a, normal)) / np.maximum(length, 1e-300)
    # Where the foot is outside of the triangle, the nearest point is on an edge.
    inside = np.ones(len(points), dtype=bool)
    nearest = np.full(len(points), np.inf)
    for begin, end in ((a, b), (b, c), (c, a)):
        edge = end - begin
        offset = points - begin
        inside &= _dot(np.cross(edge, offset), normal) >= 0.0
        fraction = _dot(offset, edge) / np.maximum(_dot(edge, edge), 1e-300)
        foot = begin + np.clip(fraction, 0.0, 1.0)[:, None] * edge
        nearest = np.minimum(nearest, np.linalg.norm(points - foot, axis=1))
    return np.where(inside, height, nearest)
