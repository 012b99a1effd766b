"""Polygons: cut into triangles, and vertices at equal positions welded.

A polygon that is convex, or that one of its corners sees as a whole, becomes a fan about that
corner. Any other polygon that does not cross itself is cut ear by ear [Meisters 1975].
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.errors import UnfitFileError

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MAX_CORNERS = 1_000
"""Corners of one face: cutting ears off takes time with the square of them."""

MAX_CUTTING_WORK = 2_000_000
"""Sum of the squares of the corners of all faces that no fan covers: about 2 s of CPU time."""

_WEIGHTS = (1.0, 0.7548776662466927, 0.5698402909980532, 0.8191725133961645, 0.6710436067037893)
"""Weights of the columns of rows in a sum that different rows seldom share: no simple ratios."""

_FLAT = 1e-9
"""Area of a triangle over that of its polygon below which it counts as flat."""


class Weld(NamedTuple):
    """Vertices at equal positions made one."""

    vertices: Indices
    """(M,): the first vertex at each position, ascending."""
    targets: Indices
    """(N,): the new number of each vertex."""


def weld(columns: Floats) -> Weld:
    """Return the weld of vertices whose rows of `columns` (N, K) are equal.

    Equal means equal bit by bit, but for the sign of zero: files write one position in one way.
    """
    count = len(columns)
    if not _may_repeat(columns):
        return Weld(np.arange(count), np.arange(count))
    # Adding 0.0 turns -0.0 into 0.0.
    _, first, inverse = np.unique(columns + 0.0, axis=0, return_index=True, return_inverse=True)
    # `unique` orders by value. Order by first appearance instead, so that a mesh without duplicates
    # stays as it is.
    order = np.argsort(first)
    ranks = np.empty_like(order)
    ranks[order] = np.arange(len(order))
    return Weld(first[order], ranks[inverse.reshape(-1)])


def repeated_numbers(numbers: Indices) -> Indices:
    """Return each number after the first that is equal to it, ascending: of 5, 5, 5 two."""
    ordered = np.sort(numbers)
    return np.asarray(ordered[1:][ordered[1:] == ordered[:-1]])


def _may_repeat(columns: Floats) -> bool:
    """Return False if no two rows of `columns` (N, K) are equal: comparing rows takes longer."""
    if columns.shape[1] > len(_WEIGHTS):
        return True
    # Equal rows have equal sums.
    sums = np.zeros(len(columns))
    for column, weight in zip(columns.T, _WEIGHTS, strict=False):
        sums += weight * column
    sums.sort()
    return bool((sums[1:] == sums[:-1]).any())


def triangulate(points: Floats, corners: Indices, sizes: Indices) -> Indices:
    """Return the triangles (T, 3) of faces, a face of n corners as n - 2 of them, in order.

    Args:
        points: Vertices (N, 2) or (N, 3) [m].
        corners: The vertices of all faces, one face after the other.
        sizes: Number of corners of each face.

    Raises:
        UnfitFileError: A face has too few or too many corners, or cannot be cut.
    """
    if not len(sizes):
        return np.zeros((0, 3), dtype=np.int64)
    if sizes.min() < 3 or sizes.max() > MAX_CORNERS:
        face = int(np.argmax((sizes < 3) | (sizes > MAX_CORNERS)))
        raise UnfitFileError(
            f"a face must have 3 to {MAX_CORNERS} corners, and face {face} has {sizes[face]}"
        )
    if (sizes == 3).all():
        return corners.reshape(-1, 3)

    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    first_corners = np.cumsum(sizes) - sizes
    first_triangles = np.cumsum(sizes - 2) - (sizes - 2)
    triangles = np.empty((int((sizes - 2).sum()), 3), dtype=np.int64)
    work = 0
    # Faces of one size are cut together.
    for size in np.unique(sizes).tolist():
        faces = np.flatnonzero(sizes == size)
        polygons = corners[first_corners[faces, None] + np.arange(size)]
        cuts, uncut = _fans(points[polygons])
        work += len(uncut) * size**2
        if work > MAX_CUTTING_WORK:
            raise UnfitFileError(
                "must have triangles: there are too many faces of many corners that are not convex"
            )
        for row in uncut.tolist():
            cuts[row] = _cut_ears(points[polygons[row]], int(faces[row]))
        rows = np.arange(len(faces))[:, None, None]
        triangles[first_triangles[faces, None] + np.arange(size - 2)] = polygons[rows, cuts]
    return triangles


def _normals(polygons: Floats) -> Floats:
    """Return the area vectors of polygons (F, n, 3), by Newell's method: 1/2 sum p_i x p_(i+1)."""
    relative = polygons - polygons[:, :1]
    normals: Floats = 0.5 * np.cross(relative, np.roll(relative, -1, axis=1)).sum(axis=1)
    return normals


def _fans(polygons: Floats) -> tuple[Indices, Indices]:
    """Return fans that cover polygons (F, n, 3), and the numbers of polygons that none covers.

    The fans are (F, n - 2, 3) corners of the polygon.
    """
    count, size, _ = polygons.shape
    fan = np.stack([np.zeros(size - 2, int), np.arange(1, size - 1), np.arange(2, size)], axis=1)
    cuts = np.repeat(fan[None], count, axis=0)
    areas = np.linalg.norm(_normals(polygons), axis=1)
    units = _normals(polygons) / np.maximum(areas, np.finfo(float).tiny)[:, None]
    pending = np.arange(count)
    for apex in range(size):
        covered = _is_fan(np.roll(polygons[pending], -apex, axis=1), units[pending], areas[pending])
        cuts[pending[covered]] = (fan + apex) % size
        pending = pending[~covered]
        if not len(pending):
            break
    return cuts, pending


def _is_fan(polygons: Floats, units: Floats, areas: Floats) -> npt.NDArray[np.bool_]:
    """Return whether the fan about the first corner covers each polygon exactly once."""
    spokes = polygons[:, 1:] - polygons[:, :1]
    before = spokes[:, :-1]
    after = spokes[:, 1:]
    doubled = np.einsum("fkx,fx->fk", np.cross(before, after), units)
    # All triangles must be turned alike, and together turn less than once around the corner.
    angles = np.arctan2(doubled, np.einsum("fkx,fkx->fk", before, after)).sum(axis=1)
    is_turned = (0.5 * doubled > _FLAT * areas[:, None]).all(axis=1)
    covered: npt.NDArray[np.bool_] = is_turned & (angles < 2 * np.pi)
    return covered


def _cut_ears(polygon: Floats, face: int) -> Indices:
    """Return a polygon (n, 3) cut ear by ear, (n - 2, 3); raise UnfitFileError."""
    flat = _project(polygon)
    area = _area(flat)
    refusal = UnfitFileError(
        f"face {face} must be a polygon that does not cross or touch itself and has an area: "
        "export triangles (in Blender: Triangulated Mesh)"
    )
    if area <= 0.0 or _crosses_itself(flat):
        raise refusal
    remaining = list(range(len(flat)))
    triangles = []
    while len(remaining) > 3:
        for position in range(len(remaining)):
            ear = [remaining[position - 1], remaining[position]]
            ear.append(remaining[(position + 1) % len(remaining)])
            corners = [corner for corner in remaining if corner not in ear]
            # An ear is a triangle inside of the polygon: turned like it, with no corner in it.
            if _area(flat[ear]) > _FLAT * area and not _contains(flat[ear], flat[corners]).any():
                triangles.append(ear)
                del remaining[position]
                break
        else:
            raise refusal
    if _area(flat[remaining]) <= 0.0:
        raise refusal
    triangles.append(remaining)
    return np.array(triangles, dtype=np.int64)


def _project(polygon: Floats) -> Floats:
    """Return a polygon (n, 3) in its mean plane, (n, 2), turned counterclockwise."""
    normal = _normals(polygon[None])[0]
    length = np.linalg.norm(normal)
    if not length > 0.0:
        return np.zeros((len(polygon), 2))
    normal = normal / length
    # Any direction that is not along the normal gives the first axis of the plane.
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    flat: Floats = (polygon - polygon[0]) @ np.stack([x, np.cross(normal, x)], axis=1)
    return flat


def _area(polygon: Floats) -> float:
    """Return the area of a polygon (n, 2), positive if it is turned counterclockwise."""
    after = np.roll(polygon, -1, axis=0)
    return float(0.5 * (polygon[:, 0] * after[:, 1] - polygon[:, 1] * after[:, 0]).sum())


def _sides(start: Floats, end: Floats, points: Floats) -> Floats:
    """Return on which side of lines points lie: positive to the left."""
    along = end - start
    across = points - start
    sides: Floats = along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0]
    return sides


def _contains(triangle: Floats, points: Floats) -> npt.NDArray[np.bool_]:
    """Return which points (n, 2) lie in a triangle turned counterclockwise, or on its border."""
    inside = np.ones(len(points), dtype=bool)
    for start, end in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
        inside &= _sides(start, end, points) >= 0.0
    return inside


def _crosses_itself(polygon: Floats) -> bool:
    """Return whether two edges of a polygon (n, 2) that are not neighbours meet."""
    count = len(polygon)
    ends = np.roll(polygon, -1, axis=0)
    first, second = np.triu_indices(count, 2)
    # The last edge is a neighbour of the first one.
    is_apart = (second - first) < count - 1
    first = first[is_apart]
    second = second[is_apart]
    # Edges from a to b and from c to d.
    a = polygon[first]
    b = ends[first]
    c = polygon[second]
    d = ends[second]
    straddles_first = _sides(a, b, c) * _sides(a, b, d) <= 0.0
    straddles_second = _sides(c, d, a) * _sides(c, d, b) <= 0.0
    # Edges on one line satisfy both without meeting, unless their boxes overlap.
    lower = np.maximum(np.minimum(a, b), np.minimum(c, d))
    upper = np.minimum(np.maximum(a, b), np.maximum(c, d))
    overlap = (lower <= upper).all(axis=1)
    return bool((straddles_first & straddles_second & overlap).any())
