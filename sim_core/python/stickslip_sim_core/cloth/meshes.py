"""Triangulations of rectangles, structured and unstructured, and of rings."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import check_positive

Diagonals = Literal["alternating", "left", "right", "random"]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangulated cloth at rest."""

    rest: NDArray[np.float64]
    """Positions of the vertices in the rest plane: (V, 2) [m]."""

    triangles: NDArray[np.int32]
    """Vertices of each triangle, counter-clockwise: (T, 3)."""

    @property
    def spacing(self) -> float:
        """Square root of twice the mean area of a triangle [m]: the side of a cell of a grid."""
        a, b, c = (self.rest[self.triangles[:, i]] for i in range(3))
        u = b - a
        v = c - a
        return float(np.sqrt(np.mean(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])))

    @property
    def rim(self) -> NDArray[np.int32]:
        """Vertices of the boundary, ascending: (R,)."""
        # Sorted ends make the two directions of an edge equal. An inner edge belongs to two
        # triangles, and an edge of the boundary to one.
        edges = np.sort(
            np.concatenate([self.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])]), axis=1
        )
        unique, counts = np.unique(edges, axis=0, return_counts=True)
        return np.unique(unique[counts == 1])


def grid(
    width: float,
    length: float,
    columns: int,
    rows: int,
    diagonals: Diagonals = "alternating",
    seed: int = 0,
) -> Mesh:
    """Triangulate a rectangle by columns x rows cells, and cut each cell along a diagonal.

    The rectangle is [-width/2, width/2] x [-length/2, length/2].

    Raises:
        ValueError: A size is not positive, or there is no such pattern.
    """
    check_positive(width=width, length=length, columns=columns, rows=rows)
    x, y = np.meshgrid(
        np.linspace(-0.5, 0.5, columns + 1) * width,
        np.linspace(-0.5, 0.5, rows + 1) * length,
        indexing="xy",
    )
    rest = np.stack([x.ravel(), y.ravel()], axis=1)
    column, row = (
        cells.ravel() for cells in np.meshgrid(np.arange(columns), np.arange(rows), indexing="xy")
    )
    # Corners of each cell, counter-clockwise from the lower left.
    a = row * (columns + 1) + column
    b = a + 1
    c = a + columns + 2
    d = a + columns + 1
    match diagonals:
        case "alternating":
            rising = (row + column) % 2 == 0
        case "right":
            rising = np.ones_like(a, dtype=bool)
        case "left":
            rising = np.zeros_like(a, dtype=bool)
        case "random":
            rising = np.random.default_rng(seed).random(a.size) < 0.5
        case _:
            raise ValueError(
                f"diagonals: must be alternating, left, right or random, got {diagonals!r}"
            )
    # Two triangles for either diagonal of every cell, from which `rising` picks a diagonal.
    up = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1)
    down = np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1)
    triangles = np.where(rising[:, None, None], up, down).reshape(-1, 3)
    return Mesh(rest, triangles.astype(np.int32))


def together(*parts: Mesh) -> Mesh:
    """Return a mesh of several sheets, which lie side by side at rest.

    Vertices keep their order, part by part. A single part stays as it is.
    """
    if len(parts) == 1:
        return parts[0]
    rest = []
    triangles = []
    right = 0.0
    count = 0
    # A gap of a tenth of each sheet's width keeps the sheets apart at rest.
    for part in parts:
        low = part.rest[:, 0].min()
        high = part.rest[:, 0].max()
        rest.append(part.rest + np.array([right - low, 0.0]))
        triangles.append(part.triangles + count)
        right += 1.1 * (high - low)
        count += len(part.rest)
    return Mesh(np.concatenate(rest), np.concatenate(triangles).astype(np.int32))


def unstructured(
    width: float, length: float, spacing: float, seed: int = 0, *, aligned: int = 0
) -> Mesh:
    """Triangulate a rectangle by a Delaunay mesh of scattered vertices.

    The rectangle is [-width/2, width/2] x [-length/2, length/2]. The vertices are rows of a
    triangular lattice with edges of about `spacing`, displaced at random by up to 0.3 spacings.
    Edges are flipped until every circumcircle is empty [Lawson 1977]. The first `aligned` rows of
    cells along the length are squares of side `spacing` instead.

    Raises:
        ValueError: A size is not positive, or the aligned rows fill the whole length.
    """
    check_positive(width=width, length=length, spacing=spacing)
    start = aligned * spacing
    if not start < length:
        raise ValueError(
            f"aligned: rows of {spacing} m must be shorter than the length of {length} m, "
            f"got {aligned}"
        )
    rng = np.random.default_rng(seed)
    columns = max(1, round(width / spacing))
    # The height of an equilateral triangle is sqrt(0.75) times its side.
    rows = max(1, round((length - start) / (spacing * np.sqrt(0.75))))
    height = (length - start) / rows
    strips = []
    for row in range(-aligned, rows + 1):
        x = np.linspace(0.0, 1.0, columns + 1)
        # Every other row is shifted by half a cell, as in a triangular lattice. It keeps a vertex
        # at both ends, so that the long edges stay straight.
        if row > 0 and row % 2 and row != rows:
            x = np.concatenate([[0.0], (np.arange(columns) + 0.5) / columns, [1.0]])
        y = start + row * (height if row > 0 else spacing)
        strips.append(np.stack([x * width, np.full_like(x, y)], axis=1))
    rows += aligned
    rest = np.concatenate(strips)
    size = np.array([width, length])
    # Vertices move in both directions inside, and not across an edge that they lie on. Aligned rows
    # do not move at all.
    inside = (rest > 1e-9 * size.max()) & (rest < size * (1.0 - 1e-9))
    inside[: (aligned + 1) * (columns + 1) if aligned else 0] = False
    rest += np.where(inside, rng.uniform(-0.3, 0.3, rest.shape) * min(width / columns, height), 0.0)
    # Zip each row and the next from left to right into triangles. The choice of the side is not
    # critical, since edges are flipped afterwards.
    starts = np.concatenate([[0], np.cumsum([len(strip) for strip in strips])])
    triangles: list[tuple[int, int, int]] = []
    for row in range(rows):
        low = list(range(starts[row], starts[row + 1]))
        high = list(range(starts[row + 1], starts[row + 2]))
        i = j = 0
        while i < len(low) - 1 or j < len(high) - 1:
            # Advance on the row whose next edge has its middle further to the left.
            along_low = j == len(high) - 1 or (
                i < len(low) - 1
                and rest[low[i + 1], 0] + rest[low[i], 0] <= rest[high[j + 1], 0] + rest[high[j], 0]
            )
            if along_low:
                triangles.append((low[i], low[i + 1], high[j]))
                i += 1
            else:
                triangles.append((low[i], high[j + 1], high[j]))
                j += 1
    flipped = _delaunay(rest, triangles)
    return Mesh(rest - np.array([width, length]) / 2.0, np.array(flipped, dtype=np.int32))


@dataclass(frozen=True, eq=False)
class Ring:
    """A triangulated ring whose inner edge is clamped."""

    mesh: Mesh
    clamped: float
    """Vertices within this radius are clamped [m].

    They are two circles: half a cell within the inner edge, and half a cell beyond it. Cloth that
    is level between the circles is level at the edge itself.
    """


def ring(inner: float, outer: float, spacing: float, seed: int = 0) -> Ring:
    """Triangulate the ring between two radii [m] by an unstructured Delaunay mesh.

    Vertices are on circles about the middle, with edges of about `spacing`. Circles are turned at
    random, and vertices within the ring are displaced at random by up to 0.2 spacings.

    Raises:
        ValueError: A size is not positive, or the ring is no wider than three spacings.
    """
    check_positive(inner=inner, outer=outer, spacing=spacing)
    if not outer - inner >= 3.0 * spacing:
        raise ValueError(
            f"spacing: must be at most a third of the width of {outer - inner:g} m, got {spacing:g}"
        )
    rng = np.random.default_rng(seed)
    # The height of an equilateral triangle is sqrt(0.75) times its side. The first circle is half
    # a height within the inner edge.
    circles = round((outer - inner) / (spacing * np.sqrt(0.75)))
    height = (outer - inner) / (circles - 0.5)
    radii = inner + height * (np.arange(circles + 1) - 0.5)
    angles = []
    strips = []
    for number, radius in enumerate(radii):
        count = round(2.0 * np.pi * radius / spacing)
        # The two clamped circles and the outer one stay circles.
        is_free = 1 < number < circles
        across, along = rng.uniform(-0.2, 0.2, (2, count)) * spacing * is_free
        angle = np.sort((np.arange(count) + rng.uniform()) * 2.0 * np.pi / count + along / radius)
        distance = radius + across
        angles.append(angle)
        strips.append(np.column_stack([distance * np.cos(angle), distance * np.sin(angle)]))
    starts = np.concatenate([[0], np.cumsum([len(strip) for strip in strips])])
    triangles: list[tuple[int, int, int]] = []
    for number in range(circles):
        zipped = _zip_circles(angles[number], angles[number + 1])
        offsets = (starts[number], starts[number + 1])
        for triangle in zipped:
            a, b, c = (int(offsets[circle] + vertex) for circle, vertex in triangle)
            triangles.append((a, b, c))
    rest = np.concatenate(strips)
    flipped = _delaunay(rest, triangles)
    return Ring(Mesh(rest, np.array(flipped, dtype=np.int32)), float(inner + 0.75 * height))


Corner = tuple[int, int]
"""Circle, 0 within and 1 beyond, and number of a vertex on it."""


def _zip_circles(
    within: NDArray[np.float64], beyond: NDArray[np.float64]
) -> list[tuple[Corner, Corner, Corner]]:
    """Return triangles between two circles, whose vertices have ascending angles [rad]."""
    # Each circle is walked once around; its first vertex comes again at the end.
    low = np.append(within, within[0] + 2.0 * np.pi)
    high = np.append(beyond, beyond[0] + 2.0 * np.pi)
    triangles: list[tuple[Corner, Corner, Corner]] = []
    i = j = 0
    while i < len(within) or j < len(beyond):
        at_low: Corner = (0, i % len(within))
        at_high: Corner = (1, j % len(beyond))
        # Advance on the circle whose next edge has its middle at the smaller angle.
        is_low = j == len(beyond) or (
            i < len(within) and low[i] + low[i + 1] <= high[j] + high[j + 1]
        )
        if is_low:
            i += 1
            triangles.append((at_low, at_high, (0, i % len(within))))
        else:
            j += 1
            triangles.append((at_low, at_high, (1, j % len(beyond))))
    return triangles


def _delaunay(
    rest: NDArray[np.float64], triangles: list[tuple[int, int, int]]
) -> list[tuple[int, int, int]]:
    """Flip edges whose opposite angles add up to more than pi, until no such edge remains."""
    cells = [list(t) for t in triangles]
    # From a directed edge to the triangle on its left.
    sides: dict[tuple[int, int], int] = {}
    for t, (a, b, c) in enumerate(cells):
        for edge in ((a, b), (b, c), (c, a)):
            sides[edge] = t

    def cotangent(corner: int, i: int, j: int) -> float:
        u = rest[i] - rest[corner]
        v = rest[j] - rest[corner]
        return float(u @ v / abs(u[0] * v[1] - u[1] * v[0]))

    def area(a: int, b: int, c: int) -> float:
        u = rest[b] - rest[a]
        v = rest[c] - rest[a]
        return float(u[0] * v[1] - u[1] * v[0])

    todo = list(sides)
    while todo:
        a, b = todo.pop()
        # An earlier flip removed the edge, or it is on the boundary.
        if (a, b) not in sides or (b, a) not in sides:
            continue
        left = sides[a, b]
        right = sides[b, a]
        c = next(v for v in cells[left] if v not in (a, b))
        d = next(v for v in cells[right] if v not in (a, b))
        # Angles add up to more than pi if the sum of their cotangents is negative. The slack keeps
        # four vertices on one circle, as in a square, from flipping back and forth forever. A flip
        # in a quadrangle that is not convex would turn a triangle over.
        if (
            cotangent(c, a, b) + cotangent(d, a, b) > -1e-9
            or min(area(a, d, c), area(d, b, c)) <= 0.0
        ):
            continue
        cells[left], cells[right] = [a, d, c], [d, b, c]
        del sides[a, b], sides[b, a]
        for t, (p, q, r) in ((left, (a, d, c)), (right, (d, b, c))):
            for edge in ((p, q), (q, r), (r, p)):
                sides[edge] = t
        # The flip changed the angles opposite to the four sides of the quadrangle.
        todo.extend([(a, d), (d, b), (b, c), (c, a)])
    return [(t[0], t[1], t[2]) for t in cells]
