"""Meshes of bodies, as they are seen: vertices (n, 3) [m] about their middle, and convex faces.

A round body is a core, a box of half sizes (x, y, z) that may be 0, grown by a radius: a ball's core is a point, a
capsule's a segment, a rounded box's a box. Its mesh is that of a ball, pulled apart between its eight octants.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Faces = list[tuple[int, ...]]

ARC = 8
"""Faces of a quarter of a circle."""
GORE = 4
"""Faces across one gore: gores are bright and dark by turns, so that a turn can be seen."""
DARK = 0.15
"""Colour of a dark gore over that of a bright one."""


def rounded(core: npt.ArrayLike, radius: float) -> tuple[Array, Faces]:
    """Return a box of half sizes (3,) [m], grown by a radius [m]."""
    quarter = np.linspace(0.0, 0.5 * np.pi, ARC + 1)
    polar = np.concatenate([quarter, quarter + 0.5 * np.pi])
    azimuth = np.concatenate([quarter + side * 0.5 * np.pi for side in range(4)])
    middle = np.repeat(0.25 * np.pi + 0.5 * np.pi * np.arange(4), ARC + 1)  # of the octant, to be pulled to
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    direction = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    octant = np.empty_like(direction)
    octant[..., 0], octant[..., 1] = np.sign(np.cos(middle)), np.sign(np.sin(middle))
    octant[..., 2] = np.repeat([1.0, -1.0], ARC + 1)[:, None]
    vertices = (radius * direction + np.asarray(core, dtype=np.float64) * octant).reshape(-1, 3)
    rings, around = p.shape
    faces: Faces = []
    for ring in range(rings - 1):
        for place in range(around):
            left, right = ring * around + place, ring * around + (place + 1) % around
            faces.append((left, left + around, right + around, right))
    corners = [side * (ARC + 1) for side in range(4)]
    return vertices, [*faces, tuple(corners), tuple((rings - 1) * around + corner for corner in reversed(corners))]


def gores(color: Array, count: int) -> Array:
    """Return a colour for each of the faces of a round body, (count, 3): gores are bright and dark by turns."""
    around = 4 * (ARC + 1)
    place = np.arange(count) % around
    within = place % (ARC + 1) // GORE  # the face between two octants goes with the gore before it
    dark = (np.minimum(within, ARC // GORE - 1) + place // (ARC + 1) * (ARC // GORE)) % 2 == 1
    return np.where(dark[:, None], DARK * color, color)


def box(size: tuple[float, float, float], center: tuple[float, float, float]) -> tuple[Array, Faces]:
    """Return the corners and faces of a box."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces: Faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.asarray(center) + 0.5 * np.asarray(size) * signs, faces


def tiles(normal: npt.ArrayLike, side: float, count: int) -> tuple[Array, Faces]:
    """Return a square across a normal (3,), cut into count x count tiles: a plane that is no floor."""
    n = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    u = np.cross(n, np.eye(3)[np.abs(n).argmin()])
    u /= np.linalg.norm(u)
    line = side * (np.arange(count + 1) / count - 0.5)
    a, b = (part.ravel()[:, None] for part in np.meshgrid(line, line, indexing="ij"))
    row = count + 1
    return a * u + b * np.cross(n, u), [
        (i * row + j, (i + 1) * row + j, (i + 1) * row + j + 1, i * row + j + 1)
        for i in range(count)
        for j in range(count)
    ]
