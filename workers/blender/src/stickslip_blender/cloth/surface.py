"""The visible cloth: the solver's mesh, refined, with weak creases and a thick hem.

The middle of the sheet is the solver's surface. Creases are a seeded height of at most half a
millimetre. A label gives their strength, because wrinkles make friction visible. The hem is a
second skin about the outer 6 mm.
"""

from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_blender.raster import _raster

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]

SHARPEST = np.radians(135.0)
"""Least angle of two edges of the boundary that do not make a corner [rad].

Corners stay in place.
"""


@dataclass(frozen=True)
class Subdivision:
    """The refinement of one mesh, from values at its vertices to values at the finer vertices."""

    triangles: Indices
    """Triangles of the finer mesh, shape (4 T, 3)."""
    _sources: Indices
    """Old vertices of each new one, padded, shape (V', n)."""
    _weights: Array
    """Weights of the old vertices, zero in the padding, shape (V', n). Each row sums to one."""

    def __call__(self, values: npt.ArrayLike) -> Array:
        """Refine values (V, k) to (V', k)."""
        return np.asarray(
            np.einsum(
                "vn,vnk->vk", self._weights, np.asarray(values, dtype=np.float64)[self._sources]
            )
        )


def subdivide(triangles: npt.ArrayLike, rest: npt.ArrayLike) -> Subdivision:
    """Make the Loop subdivision of triangles (T, 3).

    The rest shape (V, 2) gives the corners of the boundary.

    The new vertices are the moved old ones, followed by one vertex on each edge. Each new vertex is
    a mean of old ones with weights of at least zero. A cloth that lies on the floor therefore does
    not sink below it. The same rule refines every value at a vertex, for example texture
    coordinates [Loop 1987; Hoppe et al. 1994, boundary and corner rules].
    """
    old = np.asarray(triangles, dtype=np.int64)
    flat = np.asarray(rest, dtype=np.float64)
    count = len(flat)
    sides = np.concatenate([old[:, [0, 1]], old[:, [1, 2]], old[:, [2, 0]]])
    opposite = np.concatenate([old[:, 2], old[:, 0], old[:, 1]])
    edges, side_edge, uses = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    side_edge = side_edge.reshape(-1)
    if uses.max() > 2:
        raise ValueError(
            f"every edge must belong to one or two triangles; one belongs to {uses.max()}"
        )
    rows: list[dict[int, float]] = []
    ring: list[set[int]] = [set() for _ in range(count)]
    rim: list[list[int]] = [[] for _ in range(count)]
    for (a, b), used in zip(edges.tolist(), uses.tolist(), strict=True):
        ring[a].add(b)
        ring[b].add(a)
        if used == 1:
            rim[a].append(b)
            rim[b].append(a)
    for vertex in range(count):
        rows.append(_moved(vertex, sorted(ring[vertex]), rim[vertex], flat))
    across: list[list[int]] = [[] for _ in edges]
    for edge, vertex in zip(side_edge.tolist(), opposite.tolist(), strict=True):
        across[edge].append(vertex)
    for (a, b), facing in zip(edges.tolist(), across, strict=True):
        if len(facing) == 2:
            rows.append({a: 0.375, b: 0.375, facing[0]: 0.125, facing[1]: 0.125})
        else:
            rows.append({a: 0.5, b: 0.5})
    width = max(map(len, rows))
    sources = np.zeros((len(rows), width), dtype=np.int32)
    weights = np.zeros((len(rows), width))
    for number, row in enumerate(rows):
        sources[number, : len(row)] = list(row)
        weights[number, : len(row)] = list(row.values())
    ab, bc, ca = (count + side_edge).reshape(3, -1)
    a, b, c = old.T
    fine = np.concatenate(
        [np.stack(face, axis=1) for face in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    return Subdivision(fine.astype(np.int32), sources, weights)


def _moved(vertex: int, ring: list[int], rim: list[int], rest: Array) -> dict[int, float]:
    """Return the weights of an old vertex's new place."""
    if rim:
        if (
            len(rim) != 2
            or _angle(rest[rim[0]] - rest[vertex], rest[rim[1]] - rest[vertex]) < SHARPEST
        ):
            return {vertex: 1.0}
        return {vertex: 0.75, rim[0]: 0.125, rim[1]: 0.125}
    n = len(ring)
    beta = (0.625 - (0.375 + 0.25 * np.cos(2.0 * np.pi / n)) ** 2) / n
    return {vertex: 1.0 - n * beta, **dict.fromkeys(ring, beta)}


def _angle(first: Array, second: Array) -> float:
    cosine = first @ second / (np.linalg.norm(first) * np.linalg.norm(second))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


FINE_VERTICES = 6000  # target of the subdivision: a facet is then below a pixel
CREASE = 0.0005  # height of the strongest crease at strength 1 [m]
_CREASES = 14

# Profile of the hem, from its inner edge over the upper side to the outer edge and back below. Each
# point has its distance inside the edge of the sheet [m], and its height over the middle surface in
# units of half the hem's thickness.
_PROFILE = np.array(
    [
        (6.5e-3, 0.0),
        (6.0e-3, 1.0),
        (0.7e-3, 1.0),
        (-0.3e-3, 0.0),
        (0.7e-3, -1.0),
        (6.0e-3, -1.0),
        (6.5e-3, 0.0),
    ]
)


def surface(triangles: npt.ArrayLike, rest: npt.ArrayLike) -> "Surface":
    """Return the surface of a mesh, see `Surface`.

    A cache keeps the last surfaces, because making a surface takes a second.
    """
    faces = np.asarray(triangles, dtype=np.int32)
    flat = np.asarray(rest, dtype=np.float64)
    return copy(_cached_surface(faces.tobytes(), flat.tobytes()))


class Surface:
    """A refined mesh: it turns positions of the solver's vertices into visible vertices."""

    triangles: Indices
    """Triangles of the sheet and the hem, shape (T, 3)."""
    uv: Array
    """Texture coordinates, shape (V, 2): from 0 to 1 along the longer side."""
    size: tuple[float, float]
    """Size of the flat sheet, along warp and weft [m]."""
    is_rectangle: bool
    """Whether the flat sheet is a rectangle."""

    def __init__(self, triangles: npt.ArrayLike, rest: npt.ArrayLike) -> None:
        """Prepare a mesh of triangles (T, 3) with the rest shape (V, 2) [m]."""
        faces = np.asarray(triangles, dtype=np.int32)
        flat = np.asarray(rest, dtype=np.float64)
        low = flat.min(axis=0)
        high = flat.max(axis=0)
        width, height = (high - low).tolist()
        self.size = width, height
        ab, ac = (flat[faces[:, k]] - flat[faces[:, 0]] for k in (1, 2))
        area = 0.5 * np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).sum()
        # A sheet has four straight sides if its triangles fill the box around it.
        self.is_rectangle = bool(area > 0.999 * width * height)

        # Subdivide until facets are smaller than a pixel. Positions pass through the same levels.
        self._levels: list[Subdivision] = []
        while len(flat) < FINE_VERTICES:
            self._levels.append(subdivide(faces, flat))
            faces = self._levels[-1].triangles
            flat = self._levels[-1](flat)
        self._sheet = faces
        self._count = len(flat)

        # The hem is a ring of further vertices around the rim, at the offsets of its profile.
        rim = _rim(faces)
        self._profile = np.repeat(_PROFILE[:, 1], len(rim))[:, None]
        inside = np.concatenate(
            [flat[rim] + offset * _inward(flat[rim]) for offset in _PROFILE[:, 0]]
        )
        self._corners, self._weights = _located(inside, flat, faces)
        self.triangles = np.ascontiguousarray(
            np.concatenate([faces, _ring_faces(len(rim), self._count)])
        )

        # The print continues over the hem. The vertices of the hem have the coordinates of the
        # sheet below.
        uv = (np.concatenate([flat, inside]) - low) / max(self.size)
        self.uv = np.ascontiguousarray(np.clip(uv, 0.0, 1.0))
        self.apply_relief(hem=0.0)

    def apply_relief(self, *, hem: float, creases: float = 0.0, seed: int = 0) -> None:
        """Set half the hem's thickness [m], and the strength (0 to 1) and seed of the creases."""
        self._hem = hem * self._profile
        self._height = (
            creases * CREASE * _creases(self.uv[: self._count], seed) if creases > 0.0 else None
        )

    def __call__(self, positions: npt.ArrayLike) -> Array:
        """Return the visible vertices (V, 3) for the solver's positions (V', 3) [m]."""
        sheet = np.asarray(positions, dtype=np.float64)
        for level in self._levels:
            sheet = level(sheet)

        # Creases lift the sheet along its normals.
        normals = _raster.normals(sheet, self._sheet)
        if self._height is not None:
            lifted = sheet + self._height[:, None] * normals
            # A crease never goes into the floor.
            lifted[:, 2] = np.maximum(lifted[:, 2], np.minimum(sheet[:, 2], 0.0))
            sheet = lifted

        # The hem follows the creased sheet.
        middle = np.einsum("hk,hkx->hx", self._weights, sheet[self._corners])
        upward = np.einsum("hk,hkx->hx", self._weights, normals[self._corners])
        return np.concatenate([sheet, middle + self._hem * upward])


@lru_cache(maxsize=16)
def _cached_surface(triangles: bytes, rest: bytes) -> Surface:
    return Surface(
        np.frombuffer(triangles, dtype=np.int32).reshape(-1, 3), np.frombuffer(rest).reshape(-1, 2)
    )


def _creases(uv: Array, seed: int) -> Array:
    """Return the height of creases in [-1, 1] at (n, 2).

    Creases are straight ridges and furrows that fade along their length.
    """
    random = np.random.Generator(np.random.PCG64([seed, 2]))
    height = np.zeros(len(uv))
    for _ in range(_CREASES):
        middle = random.random(2)
        angle = random.uniform(0.0, np.pi)
        width = random.uniform(0.015, 0.03)
        length = random.uniform(0.1, 0.4)
        along = (uv - middle) @ [np.cos(angle), np.sin(angle)]
        across = (uv - middle) @ [-np.sin(angle), np.cos(angle)]
        ridge = np.exp(-((across / width) ** 2) - (along / length) ** 2)
        height += random.choice([-1.0, 1.0]) * random.uniform(0.4, 1.0) * ridge
    return np.clip(height, -1.0, 1.0)


def _rim(faces: Indices) -> npt.NDArray[np.int64]:
    """Return the vertices of the boundary in order, with the sheet on their left."""
    sides = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, index, uses = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    after = dict(sides[uses[index.reshape(-1)] == 1].tolist())
    start = vertex = min(after)
    loop = [start]
    while (vertex := after[vertex]) != start:
        loop.append(vertex)
    if len(loop) != len(after):
        raise ValueError("the cloth must have one edge all around")
    return np.array(loop)


def _inward(rim: Array) -> Array:
    """Return the direction into the sheet at each vertex of its edge (n, 2).

    A step along this vector moves both sides at the vertex inwards by 1.
    """

    def unit(v: Array) -> Array:
        return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))

    def left(v: Array) -> Array:
        return np.stack([-v[:, 1], v[:, 0]], axis=1)

    before = unit(rim - np.roll(rim, 1, axis=0))
    after = unit(np.roll(rim, -1, axis=0) - rim)
    mean = unit(left(before) + left(after))
    return np.asarray(mean / (mean * left(after)).sum(axis=1, keepdims=True))


def _located(points: Array, flat: Array, faces: Indices) -> tuple[Indices, Array]:
    """Return the corners (n, 3) and barycentric weights (n, 3) of flat points.

    The corners belong to the triangle that contains the point best.
    """
    a, b, c = (flat[faces[:, k]] for k in range(3))
    inverse = np.linalg.inv(np.stack([b - a, c - a], axis=-1))  # (T, 2, 2)
    middle = (a + b + c) / 3.0
    reach = 2.0 * np.abs(np.concatenate([b - a, c - a, c - b])).max()
    corners = np.empty((len(points), 3), dtype=np.int32)
    weights = np.empty((len(points), 3))
    for number, point in enumerate(points):
        near = np.flatnonzero((np.abs(middle - point) < reach).all(axis=1))
        bc = np.einsum("tij,tj->ti", inverse[near], point - a[near])
        all_three = np.column_stack([1.0 - bc.sum(axis=1), bc])
        best = int(all_three.min(axis=1).argmax())
        corners[number] = faces[near[best]]
        weights[number] = all_three[best]
    return corners, weights


def _ring_faces(around: int, first: int) -> npt.NDArray[Any]:
    """Return the triangles of a strip about the edge.

    The strip has len(_PROFILE) rings of `around` vertices.
    """
    here = np.arange(around)
    following = np.roll(here, -1)
    faces = []
    for ring in range(len(_PROFILE) - 1):
        outer = first + ring * around
        inner = first + (ring + 1) * around
        faces += [np.stack([outer + here, inner + here, outer + following], axis=1)]
        faces += [np.stack([outer + following, inner + here, inner + following], axis=1)]
    return np.concatenate(faces).astype(np.int32)
