"""Meshes of bodies, as they are seen: vertices (n, 3) [m] about their middle, and convex faces.

A round body is a core, a box of half sizes (x, y, z) that may be 0, grown by a radius: a ball's core is a point, a
capsule's a segment, a rounded box's a box. Its mesh is that of a ball, pulled apart between its eight octants.
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Faces = list[tuple[int, ...]]

ARC = 12  # faces of a quarter of a circle
GORE = 6
"""Faces across one gore: gores are bright and dark by turns, so that a turn can be seen."""
_JOINT = 1e-7  # [m]: vertices that are closer are one
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
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces: Faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.asarray(center) + 0.5 * np.asarray(size) * signs, faces


def square(normal: npt.ArrayLike, side: float) -> tuple[Array, Faces]:
    """Return a square across a normal (3,): a plane that is no floor."""
    n = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    u = np.cross(n, np.eye(3)[np.abs(n).argmin()])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    return 0.5 * side * np.stack([-u - v, u - v, u + v, v - u]), [(0, 1, 2, 3)]


def tiled(vertices: Array, faces: Faces, side: float) -> tuple[Array, Faces, npt.NDArray[np.int64]]:
    """Cut quadrilaterals into tiles of at most a side [m]; return also the face that each tile is of.

    Vertices in one place are joined, so that a skin has no seams. The rasteriser leaves out what reaches behind the
    camera: a large face would vanish as a whole.
    """
    points = [vertices]
    pieces: Faces = []
    owners: list[int] = []
    count = len(vertices)
    for number, face in enumerate(faces):
        a, b, c, d = vertices[list(face)]
        across = max(1, int(np.ceil(max(np.linalg.norm(b - a), np.linalg.norm(c - d)) / side)))
        along = max(1, int(np.ceil(max(np.linalg.norm(d - a), np.linalg.norm(c - b)) / side)))
        if across == along == 1:
            pieces.append(face)
            owners.append(number)
            continue
        u, v = (line[..., None] for line in np.mgrid[0 : across + 1, 0 : along + 1] / np.array([[[across]], [[along]]]))
        points.append((((1 - u) * a + u * b) * (1 - v) + ((1 - u) * d + u * c) * v).reshape(-1, 3))
        row = along + 1
        corners = [count + i * row + j for i in range(across) for j in range(along)]
        pieces += [(corner, corner + row, corner + row + 1, corner + 1) for corner in corners]
        owners += [number] * len(corners)
        count += len(points[-1])
    given = np.concatenate(points)
    _, first, joint = np.unique(np.round(given / _JOINT), axis=0, return_index=True, return_inverse=True)
    rings = [tuple(dict.fromkeys(joint.ravel()[list(piece)].tolist())) for piece in pieces]
    kept = [number for number, ring in enumerate(rings) if len(ring) > 2]
    return given[first], [rings[number] for number in kept], np.array(owners)[kept]
