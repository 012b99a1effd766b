"""Loop subdivision of a triangle mesh with a boundary [Loop 1987; Hoppe et al. 1994, boundary and corner rules].

Every new vertex is a mean of old ones with weights that are not negative, so a cloth that lies on the floor does not
get below it, and everything that is given by vertex, texture coordinates too, is refined by the same rule.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]

SHARPEST = np.radians(135.0)
"""Two edges of the boundary that meet at a smaller angle make a corner, which stays where it is."""


@dataclass(frozen=True)
class Subdivision:
    """How one mesh is refined: from values at its vertices to values at those of the finer one."""

    triangles: Indices
    """Of the finer mesh, shape (4 T, 3)."""
    _sources: Indices
    """Old vertices of each new one, padded, shape (V', n)."""
    _weights: Array
    """Their weights, zero in the padding, shape (V', n); each row sums to one."""

    def __call__(self, values: npt.ArrayLike) -> Array:
        """Refine values (V, k) to (V', k)."""
        return np.asarray(np.einsum("vn,vnk->vk", self._weights, np.asarray(values, dtype=np.float64)[self._sources]))


def subdivide(triangles: npt.ArrayLike, rest: npt.ArrayLike) -> Subdivision:
    """Make the subdivision of a mesh of triangles (T, 3); its rest shape (V, 2) says where its corners are.

    New vertices are the old ones, moved, and then one on each edge.
    """
    old = np.asarray(triangles, dtype=np.int64)
    flat = np.asarray(rest, dtype=np.float64)
    count = len(flat)
    sides = np.concatenate([old[:, [0, 1]], old[:, [1, 2]], old[:, [2, 0]]])
    opposite = np.concatenate([old[:, 2], old[:, 0], old[:, 1]])
    edges, side_edge, uses = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    side_edge = side_edge.reshape(-1)
    if uses.max() > 2:
        raise ValueError(f"every edge must belong to one or two triangles; one belongs to {uses.max()}")
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
    fine = np.concatenate([np.stack(face, axis=1) for face in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return Subdivision(fine.astype(np.int32), sources, weights)


def _moved(vertex: int, ring: list[int], rim: list[int], rest: Array) -> dict[int, float]:
    """Return the weights of an old vertex's new place."""
    if rim:
        if len(rim) != 2 or _angle(rest[rim[0]] - rest[vertex], rest[rim[1]] - rest[vertex]) < SHARPEST:
            return {vertex: 1.0}
        return {vertex: 0.75, rim[0]: 0.125, rim[1]: 0.125}
    n = len(ring)
    beta = (0.625 - (0.375 + 0.25 * np.cos(2.0 * np.pi / n)) ** 2) / n
    return {vertex: 1.0 - n * beta, **dict.fromkeys(ring, beta)}


def _angle(first: Array, second: Array) -> float:
    cosine = first @ second / (np.linalg.norm(first) * np.linalg.norm(second))
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))
