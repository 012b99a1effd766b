"""Geometry of triangles: which cross, which points lie on them, and which a ray meets first.

Candidates come from trees of boxes (`box_trees`).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.box_trees import BoxTree, Workload, overlapping_boxes

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

EDGE_SLACK = 1e-12
"""Share of a triangle beyond its edge at which a ray still meets it: rounding leaves no gap there.
"""

PLANE_SLACK = 1e-12
"""Distance from a plane that rounding can give to a point on it [m]; coordinates are up to 100 m.
"""


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
    def planes(self) -> tuple[Floats, Floats]:
        """Normals n (T, 3) of length 1 and offsets d (T,) [m] of n x = d; 0 without an area."""
        a, b, c = self.corners.transpose(1, 0, 2)
        normals = _cross_product(b - a, c - a)
        normals /= np.maximum(np.sqrt(_dot(normals, normals)), 1e-300)[:, None]
        return normals, _dot(normals, a)

    @cached_property
    def tree(self) -> BoxTree:
        """The boxes of the triangles."""
        a, b, c = self.corners.transpose(1, 0, 2)
        low = np.minimum(np.minimum(a, b), c)
        return BoxTree(low, np.maximum(np.maximum(a, b), c))

    @cached_property
    def tree_of_vertices(self) -> BoxTree:
        """The boxes of the vertices, which have no size."""
        return BoxTree(self.vertices, self.vertices)

    @cached_property
    def thin_axis(self) -> Floats:
        """The direction (3,) along which it extends least, of length 1."""
        centered = self.vertices - self.vertices.mean(axis=0)
        return np.asarray(np.linalg.eigh(centered.T @ centered)[1][:, 0])


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


def are_apart(first: TriangleMesh, second: TriangleMesh, reach: float) -> bool:
    """Return True if a plane along either mesh parts both by more than `reach` [m].

    Many sheets over each other are done with so. False says nothing.
    """
    for axis in (first.thin_axis, second.thin_axis):
        places_first, places_second = first.vertices @ axis, second.vertices @ axis
        gaps = (places_first.min() - places_second.max(), places_second.min() - places_first.max())
        if max(gaps) > reach:
            return True
    return False


# ---- Crossings


def find_crossing(
    first: TriangleMesh, second: TriangleMesh, workload: Workload, *, batches: int | None = None
) -> Crossing | None:
    """Return two triangles of two meshes that cross; None if none do.

    `batches` ends the search after so many batches of candidates, where another fault is known.
    Raises TooManyPairsError.
    """
    for i, j in islice(overlapping_boxes(first.tree, second.tree, workload), batches):
        crossing = _first_crossing(first, second, i, j)
        if crossing is not None:
            return crossing
    return None


def find_self_crossing(mesh: TriangleMesh, workload: Workload) -> Crossing | None:
    """Return two triangles of one mesh that cross and share no vertex; None if none do.

    Raises TooManyPairsError.
    """
    vertices = mesh.triangles.T
    for i, j in overlapping_boxes(mesh.tree, mesh.tree, workload):
        # Neighbours meet at the vertices that they share, which is no crossing.
        shares = np.zeros(len(i), dtype=bool)
        for first in vertices:
            for second in vertices:
                shares |= first[i] == second[j]
        i, j = i[~shares], j[~shares]
        crossing = _first_crossing(mesh, mesh, np.minimum(i, j), np.maximum(i, j))
        if crossing is not None:
            return crossing
    return None


def _first_crossing(
    first: TriangleMesh, second: TriangleMesh, i: Integers, j: Integers
) -> Crossing | None:
    """Return the first of pairs of triangles, i of one mesh and j of another, that cross."""
    # Most neighbours lie on one side of the other's plane, and are done with here.
    reaches = _reaches_plane(first, i, second, j)
    i, j = i[reaches], j[reaches]
    reaches = _reaches_plane(second, j, first, i)
    i, j = i[reaches], j[reaches]
    crosses = _cross(first.corners[i], second.corners[j])
    if not crosses.any():
        return None
    number = int(np.argmax(crosses))
    x, y, z = first.corners[i[number]].mean(axis=0).tolist()
    return Crossing(int(i[number]), int(j[number]), (x, y, z))


def _reaches_plane(
    first: TriangleMesh, i: Integers, second: TriangleMesh, j: Integers
) -> npt.NDArray[np.bool_]:
    """Return whether triangles i of a mesh may have corners on both sides of planes j: (N,)."""
    normals, offsets = second.planes
    heights = np.einsum("nij,nj->ni", first.corners[i], normals[j]) - offsets[j][:, None]
    a, b, c = heights.T
    lowest = np.minimum(np.minimum(a, b), c)
    highest = np.maximum(np.maximum(a, b), c)
    return np.asarray((lowest <= PLANE_SLACK) & (highest >= -PLANE_SLACK))


def _cross(first: Floats, second: Floats) -> npt.NDArray[np.bool_]:
    """Return whether an edge of either triangle pierces the other: (N,), of corners (N, 3, 3)."""
    pierces = np.zeros(len(first), dtype=bool)
    for triangles, cutters in ((first, second), (second, first)):
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


def find_touch(
    first: TriangleMesh, second: TriangleMesh, reach: float, workload: Workload
) -> Touch | None:
    """Return a vertex of a mesh that is nearer to a triangle of another one than `reach` [m].

    None if none is. Raises TooManyPairsError.
    """
    normals, offsets = second.planes
    trees = (first.tree_of_vertices, second.tree)
    for i, j in overlapping_boxes(*trees, workload, reach=reach):
        # A triangle is no nearer than its plane.
        heights = np.abs(_dot(first.vertices[i], normals[j]) - offsets[j])
        is_near = heights < reach + PLANE_SLACK
        i, j = i[is_near], j[is_near]
        distances = _distances(first.vertices[i], second.corners[j])
        touches = distances < reach
        if touches.any():
            number = int(np.argmax(touches))
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


def ray_lengths(
    mesh: TriangleMesh, points: Floats, direction: Floats, farthest: float, workload: Workload
) -> Floats:
    """Return how far rays from points (N, 3) go until they meet a mesh, (N,) [m]; inf: never.

    Args:
        mesh: The triangles.
        points: Where the rays begin [m].
        direction: Of all rays, of length 1: (3,).
        farthest: Length at which rays end [m].
        workload: The comparisons that are allowed.

    Raises:
        TooManyPairsError: The workload ends.
    """
    # In axes of which the last is along the rays, a ray meets what it meets seen from its end.
    axes = np.linalg.svd(direction[None])[2][[1, 2, 0]]
    axes[2] = direction
    rotated = TriangleMesh(mesh.vertices @ axes.T, mesh.triangles)
    starts = points @ axes.T
    lengths = np.full(len(points), np.inf)
    rays = BoxTree(starts, starts + np.array([0.0, 0.0, farthest]))
    for i, j in overlapping_boxes(rays, rotated.tree, workload):
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
