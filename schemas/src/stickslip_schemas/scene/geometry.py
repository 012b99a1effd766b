"""Geometry of triangles: which cross, which points lie on them, and which a ray meets first.

Candidates come from two trees of boxes, so that the cost grows with the number of triangles, not
with its square.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

CANDIDATES_AT_ONCE = 100_000
"""Candidates that are compared in one operation: bounds the memory to about 100 MB."""

EDGE_SLACK = 1e-12
"""Share of a triangle beyond its edge at which a ray still meets it: rounding leaves no gap there.
"""

MORTON_BITS = 10
"""Bits of each coordinate of a Morton code: boxes that are neighbours in it are near each other."""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles of one sheet or body."""

    vertices: Floats
    """(V, 3) [m]"""

    triangles: Integers
    """(T, 3)"""

    @cached_property
    def corners(self) -> Floats:
        """(T, 3, 3) [m]: the positions of the corners of each triangle."""
        return self.vertices[self.triangles]

    @cached_property
    def tree(self) -> "BoxTree":
        """The boxes of the triangles."""
        return BoxTree(self.corners.min(axis=1), self.corners.max(axis=1))


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


def overlapping_boxes(first: BoxTree, second: BoxTree) -> Iterator[tuple[Integers, Integers]]:
    """Yield the pairs of boxes that overlap, as numbers of boxes, in batches."""
    start = (np.zeros(1, np.int64), np.zeros(1, np.int64), 0, 0)
    waiting = [start]
    while waiting:
        i, j, level_first, level_second = waiting.pop()
        low_first, high_first = first.levels[level_first]
        low_second, high_second = second.levels[level_second]
        overlaps = (low_first[i] <= high_second[j]) & (low_second[j] <= high_first[i])
        overlap_everywhere = overlaps.all(axis=1)
        i = i[overlap_everywhere]
        j = j[overlap_everywhere]
        if not len(i):
            continue
        if level_first == first.depth and level_second == second.depth:
            yield first.order[i], second.order[j]
            continue
        # Both trees are descended by one level, as long as they have another.
        if level_first < first.depth:
            i, j = np.repeat(2 * i, 2) + np.tile([0, 1], len(i)), np.repeat(j, 2)
            level_first += 1
        if level_second < second.depth:
            j, i = np.repeat(2 * j, 2) + np.tile([0, 1], len(j)), np.repeat(i, 2)
            level_second += 1
        for begin in range(0, len(i), CANDIDATES_AT_ONCE):
            end = begin + CANDIDATES_AT_ONCE
            waiting.append((i[begin:end], j[begin:end], level_first, level_second))


# ---- Crossings


def find_crossing(
    first: TriangleMesh, second: TriangleMesh, *, batches: int | None = None
) -> Crossing | None:
    """Return two triangles of two meshes that cross; None if none do.

    `batches` ends the search after so many batches of candidates, where another fault is known.
    """
    corners_first = first.corners
    corners_second = second.corners
    for i, j in islice(overlapping_boxes(first.tree, second.tree), batches):
        crosses = _cross(corners_first[i], corners_second[j])
        if crosses.any():
            return _crossing(i, j, crosses, corners_first)
    return None


def find_self_crossing(mesh: TriangleMesh) -> Crossing | None:
    """Return two triangles of one mesh that cross and share no vertex; None if none do."""
    corners = mesh.corners
    for i, j in overlapping_boxes(mesh.tree, mesh.tree):
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


def _cross(first: Floats, second: Floats) -> npt.NDArray[np.bool_]:
    """Return whether an edge of either triangle pierces the other: (N,), of corners (N, 3, 3)."""
    pierces = np.zeros(len(first), dtype=bool)
    for triangles, cutters in ((first, second), (second, first)):
        # Most neighbours lie on one side of each other's plane, and are done with here.
        sides = _sides(cutters, triangles)
        straddling = np.flatnonzero((sides.min(axis=1) < 0.0) & (sides.max(axis=1) > 0.0))
        for corner in range(3):
            after = (corner + 1) % 3
            through = straddling[sides[straddling, corner] * sides[straddling, after] < 0.0]
            begin = cutters[through, corner]
            pierces[through] |= _passes(begin, cutters[through, after] - begin, triangles[through])
    return pierces


def _sides(points: Floats, triangles: Floats) -> Floats:
    """Return on which side of the planes of triangles (N, 3, 3) points (N, 3, 3) are: (N, 3)."""
    first = triangles[:, :1]
    normals = _cross_product(triangles[:, 1] - first[:, 0], triangles[:, 2] - first[:, 0])
    return np.asarray(np.einsum("nij,nj->ni", points - first, normals))


def _passes(begin: Floats, way: Floats, triangles: Floats) -> npt.NDArray[np.bool_]:
    """Return whether lines from `begin` along `way`, (N, 3) each, pass through triangles (N, 3, 3).

    The border counts.
    """
    # The line passes on the same side of all three edges if it passes through the triangle.
    a, b, c = (triangles[:, corner] - begin for corner in range(3))
    volumes = np.stack([_dot(way, _cross_product(p, q)) for p, q in ((a, b), (b, c), (c, a))])
    return np.asarray((volumes >= 0.0).all(axis=0) | (volumes <= 0.0).all(axis=0))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("ij,ij->i", a, b))


def _cross_product(a: Floats, b: Floats) -> Floats:
    """Return a x b of rows (N, 3); `np.cross` copies more than it computes."""
    out = np.empty_like(a)
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        out[:, axis] = a[:, after] * b[:, last] - a[:, last] * b[:, after]
    return out


# ---- Distances


def find_touch(points: Floats, mesh: TriangleMesh, reach: float) -> Touch | None:
    """Return a vertex of points (V, 3) that is nearer to a triangle than `reach` [m].

    None if none is.
    """
    corners = mesh.corners
    tree_of_points = BoxTree(points - reach, points + reach)
    for i, j in overlapping_boxes(tree_of_points, mesh.tree):
        distances = _distances(points[i], corners[j])
        near = distances < reach
        if near.any():
            number = int(np.argmax(near))
            return Touch(int(i[number]), int(j[number]), float(distances[number]))
    return None


def _distances(points: Floats, triangles: Floats) -> Floats:
    """Return the distances (N,) [m] of points (N, 3) from triangles (N, 3, 3)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = _cross_product(b - a, c - a)
    length = np.sqrt(_dot(normal, normal))
    height = np.abs(_dot(points - a, normal)) / np.maximum(length, 1e-300)
    # Where the foot is outside of the triangle, the nearest point is on an edge.
    inside = np.ones(len(points), dtype=bool)
    nearest = np.full(len(points), np.inf)
    for begin, end in ((a, b), (b, c), (c, a)):
        edge = end - begin
        offset = points - begin
        inside &= _dot(_cross_product(edge, offset), normal) >= 0.0
        fraction = _dot(offset, edge) / np.maximum(_dot(edge, edge), 1e-300)
        foot = begin + np.clip(fraction, 0.0, 1.0)[:, None] * edge
        nearest = np.minimum(nearest, np.linalg.norm(points - foot, axis=1))
    return np.where(inside, height, nearest)


# ---- Rays


def ray_lengths(mesh: TriangleMesh, points: Floats, direction: Floats, farthest: float) -> Floats:
    """Return how far rays from points (N, 3) go until they meet a mesh, (N,) [m]; inf: never.

    Args:
        mesh: The triangles.
        points: Where the rays begin [m].
        direction: Of all rays, of length 1: (3,).
        farthest: Length at which rays end [m].
    """
    # In axes of which the last is along the rays, a ray meets what it meets seen from its end.
    axes = np.linalg.svd(direction[None])[2][[1, 2, 0]]
    axes[2] = direction
    rotated = TriangleMesh(mesh.vertices @ axes.T, mesh.triangles)
    starts = points @ axes.T
    lengths = np.full(len(points), np.inf)
    rays = BoxTree(starts, starts + np.array([0.0, 0.0, farthest]))
    for i, j in overlapping_boxes(rays, rotated.tree):
        heights = _heights(starts[i, :2], rotated.corners[j])
        ahead = heights >= starts[i, 2]
        np.minimum.at(lengths, i[ahead], heights[ahead] - starts[i[ahead], 2])
    return np.where(lengths <= farthest, lengths, np.inf)


def _heights(places: Floats, triangles: Floats) -> Floats:
    """Return the height of triangles (N, 3, 3) at places (N, 2); NaN beside them, or upright."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    doubled = _turn(b - a, c - a)
    # The weight of a corner is the share of the triangle that the place cuts off opposite of it.
    with np.errstate(divide="ignore", invalid="ignore"):
        weight_b = _turn(places - a[:, :2], c - a) / doubled
        weight_c = _turn(b - a, places - a[:, :2]) / doubled
        weight_a = 1.0 - weight_b - weight_c
        height = weight_a * a[:, 2] + weight_b * b[:, 2] + weight_c * c[:, 2]
    inside = np.minimum(np.minimum(weight_a, weight_b), weight_c) >= -EDGE_SLACK
    return np.where(inside, height, np.nan)


def _turn(a: Floats, b: Floats) -> Floats:
    """Return the cross product of the first two coordinates of rows: (N,)."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
