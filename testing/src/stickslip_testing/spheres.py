"""Spheres of triangles."""

import numpy as np
from numpy.typing import NDArray


def icosphere(subdivisions: int) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return the vertices (V, 3) and the outward triangles (T, 3) of a sphere of radius 1.

    It is an icosahedron whose 20 triangles are each cut into four so many times.
    """
    t = 0.5 * (1.0 + np.sqrt(5.0))
    vertices = np.array(
        [np.roll([0.0, s, r * t], k) for k in range(3) for s in (-1.0, 1.0) for r in (-1.0, 1.0)]
    )
    near = np.linalg.norm(vertices[:, None] - vertices, axis=2) < 2.1
    triangles = np.array(
        [
            (a, b, c) if np.linalg.det(vertices[[a, b, c]]) > 0.0 else (a, c, b)
            for a in range(12)
            for b in range(a)
            for c in range(b)
            if near[a, b] and near[b, c] and near[c, a]
        ]
    )
    for _ in range(subdivisions):
        edges = np.sort(triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
        unique, edge_of_side = np.unique(edges, axis=0, return_inverse=True)
        a, b, c = triangles.T
        x, y, z = edge_of_side.reshape(-1, 3).T + len(vertices)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        triangles = np.concatenate(
            [np.stack(corner, axis=1) for corner in ((a, z, y), (z, b, x), (y, x, c), (x, y, z))]
        )
    return vertices / np.linalg.norm(vertices, axis=1)[:, None], triangles.astype(np.int32)
