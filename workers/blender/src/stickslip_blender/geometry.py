"""What stands on the drop-and-drag stage, as triangles: the cloth that is seen, and two holders at its corners.

The scene in Blender and the rasteriser are both made of it, so that they see the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_blender.surface import Surface

FLOOR = -0.0005
"""Height at which the floor is seen [m]: half a thickness below the middle surface of a cloth that lies on it."""

HOLDER = (0.004, 0.01, 0.01)
"""Of the clip at a corner [m]: across the cloth, and in its plane as in the simulation."""
ROD = (0.003, 0.003, 0.5)
"""Of the rod that the clip hangs on [m]."""

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]


class DragGeometry:
    """The stage's triangles, from the solver's positions."""

    triangles: Indices
    """Shape (T, 3): those of the cloth, then those of the holders."""
    cloth_triangles: int
    """How many of them are the cloth's."""
    uv: Array
    """Texture coordinates of all vertices; those of the holders are 0."""

    def __init__(
        self, triangles: npt.ArrayLike, rest: npt.ArrayLike, *, hem: float, creases: float = 0.0, seed: int = 0
    ) -> None:
        """Prepare a mesh of triangles (T, 3) with the rest shape (V, 2) [m], held edge last; hem as `Surface` has it."""
        flat = np.asarray(rest, dtype=np.float64)
        self.vertices = len(flat)
        low, high = flat.min(axis=0), flat.max(axis=0)
        corners = np.array([(low[0], high[1]), (high[0], high[1])])
        self._held = np.abs(flat[:, None] - corners).sum(axis=2).argmin(axis=0)
        inward = np.sign((low + high) / 2 - corners) * HOLDER[1] / 2
        self._grips = np.pad(inward, ((0, 0), (1, 0)))  # from a corner to the middle of its holder (x, y, z) [m]
        self.surface = Surface(triangles, rest, hem=hem, creases=creases, seed=seed)
        self.cloth_triangles = len(self.surface.triangles)
        self._box, faces = holder_mesh()
        halves = np.array([(a, b, c) for a, b, c, _ in faces] + [(a, c, d) for a, _, c, d in faces])
        first = len(self.surface.uv) + len(self._box) * np.arange(2)
        holders = (halves + first[:, None, None]).reshape(-1, 3)
        self.triangles = np.ascontiguousarray(np.concatenate([self.surface.triangles, holders]), dtype=np.int32)
        self.uv = np.concatenate([self.surface.uv, np.zeros((2 * len(self._box), 2))])

    def holders(self, positions: npt.ArrayLike) -> Array:
        """Return the middles of the two holders, shape (2, 3) [m]."""
        held: Array = np.asarray(positions, dtype=np.float64)[self._held] + self._grips
        return held

    def points(self, positions: npt.ArrayLike) -> Array:
        """Return all vertices, shape (V, 3) [m], of the solver's positions (V', 3) [m]."""
        holders = [middle + self._box for middle in self.holders(positions)]
        return np.concatenate([self.surface(positions), *holders])

    def checked(self, positions: npt.ArrayLike) -> Array:
        """Return positions (frames, V', 3) [m], or say why they are not this cloth's."""
        track = np.asarray(positions, dtype=np.float64)
        if track.ndim != 3 or track.shape[1:] != (self.vertices, 3) or not np.isfinite(track).all():
            raise ValueError(
                f"positions must be finite, of shape (frames, {self.vertices}, 3); got shape {track.shape}"
            )
        return track


def mirrored(points: Array) -> Array:
    """Return points as the floor mirrors them."""
    image = points.copy()
    image[:, 2] = 2.0 * FLOOR - image[:, 2]
    return image


def holder_mesh() -> tuple[Array, list[tuple[int, ...]]]:
    """Return the vertices of a holder about the middle of its clip [m], and its faces."""
    boxes = [_box(HOLDER, (0.0, 0.0, 0.0)), _box(ROD, (0.0, 0.0, ROD[2] / 2))]
    faces = [tuple(8 * number + index for index in face) for number, (_, box) in enumerate(boxes) for face in box]
    return np.concatenate([corners for corners, _ in boxes]), faces


def _box(
    size: tuple[float, float, float], center: tuple[float, float, float]
) -> tuple[npt.NDArray[Any], list[tuple[int, ...]]]:
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces: list[tuple[int, ...]] = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.asarray(center) + 0.5 * np.asarray(size) * signs, faces
