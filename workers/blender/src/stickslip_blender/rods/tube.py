"""The surface of a rod: a tube of fixed topology swept along a centreline."""

import numpy as np
import numpy.typing as npt

SIDES = 24  # a 24-gon is at most 0.9 % of the radius inside its circle
CAP_RINGS = 4  # of the half sphere on the free end, its pole not counted

FloatArray = npt.NDArray[np.float64]


def transport_frames(tangents: FloatArray) -> FloatArray:
    """Carry a normal along unit tangents (n, 3) without twist; return (n, 2, 3), two unit normals at each point.

    From point to point the frame turns by the least rotation that takes the tangent t to t', which for a normal n is
    n' = n - (n . t') (t + t') / (1 + t . t').
    """
    normals = np.empty_like(tangents)
    axis = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    normal = axis - (axis @ tangents[0]) * tangents[0]
    normals[0] = normal / np.linalg.norm(normal)
    for i in range(1, len(tangents)):
        before, here = tangents[i - 1], tangents[i]
        normal = normals[i - 1] - (normals[i - 1] @ here) / (1.0 + before @ here) * (before + here)
        normal -= (normal @ here) * here  # rounding would add up
        normals[i] = normal / np.linalg.norm(normal)
    return np.stack([normals, np.cross(tangents, normals)], axis=1)


def tube_vertices(centerline: FloatArray, radius: float) -> FloatArray:
    """Return the vertices of the tube about a centreline (n, 3), shape (n SIDES + CAP_RINGS SIDES + 2, 3).

    In order: n rings, the rings of the round end, its pole, the middle of the flat end in the clamp.
    """
    tangents = np.gradient(centerline, axis=0, edge_order=2)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normals = transport_frames(tangents)
    angle = 2.0 * np.pi / SIDES * np.arange(SIDES)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)  # (SIDES, 2)
    rings = centerline[:, None] + radius * circle @ normals  # (n, SIDES, 3)
    rise = np.pi / 2.0 / (CAP_RINGS + 1) * np.arange(1, CAP_RINGS + 1)[:, None, None]
    cap = centerline[-1] + radius * (np.cos(rise) * (circle @ normals[-1]) + np.sin(rise) * tangents[-1])
    pole = centerline[-1] + radius * tangents[-1]
    return np.concatenate([rings.reshape(-1, 3), cap.reshape(-1, 3), pole[None], centerline[:1]])


def tube_faces(points: int) -> list[tuple[int, ...]]:
    """Return the faces of the tube about a centreline of so many points, outward normals, as vertex indices."""
    rings = points + CAP_RINGS
    pole, middle = rings * SIDES, rings * SIDES + 1
    faces: list[tuple[int, ...]] = []
    for ring in range(rings - 1):
        for side in range(SIDES):
            a, b = ring * SIDES + side, ring * SIDES + (side + 1) % SIDES
            faces.append((a, b, b + SIDES, a + SIDES))
    for side in range(SIDES):
        a, b = side, (side + 1) % SIDES
        faces.append(((rings - 1) * SIDES + a, (rings - 1) * SIDES + b, pole))
        faces.append((b, a, middle))
    return faces
