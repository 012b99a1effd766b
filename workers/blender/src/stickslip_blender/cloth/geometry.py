"""The triangles of a scene of cloth: the refined cloth, and props.

The scene in Blender and the rasteriser are built from the same triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
import numpy.typing as npt

from stickslip_blender.cloth.surface import Surface
from stickslip_blender.raster import fans

FLOOR = -0.0005
"""Height at which the floor is seen [m]: half a thickness below the middle surface of a cloth that lies on it."""

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]
Faces = list[tuple[int, ...]]


@dataclass(frozen=True)
class Prop:
    """An object beside the cloth."""

    name: str
    vertices: Array
    """In its own axes, shape (n, 3) [m]."""
    faces: Faces
    """Convex polygons."""
    color: tuple[float, float, float]
    """Linear."""
    roughness: float
    is_smooth: bool = False
    """Whether its faces are shaded as one smooth skin."""


class Surroundings(Protocol):
    """The props of a scene, and where they are."""

    props: tuple[Prop, ...]

    def placed(self, instant: int, vertices: Array) -> list[Array]:
        """Return the vertices of each prop (n, 3) [m] at an instant, with the cloth at vertices (V, 3) [m]."""

    def aim(self, instant: int, vertices: Array) -> Array:
        """Return the point that the lamp follows (3,) [m]."""


class Geometry:
    """The triangles of a scene, from the solver's positions."""

    triangles: Indices
    """Shape (T, 3): those of the cloth, then those of the props."""
    cloth_triangles: int
    """How many of them are the cloth's."""
    uv: Array
    """Texture coordinates of all vertices; those of the props are 0."""

    def __init__(self, triangles: npt.ArrayLike, rest: npt.ArrayLike, surroundings: Surroundings) -> None:
        """Prepare a mesh of triangles (T, 3) with the rest shape (V, 2) [m]."""
        self.vertices = len(np.asarray(rest))
        self.surroundings = surroundings
        self.surface = Surface(triangles, rest)
        self.cloth_vertices, self.cloth_triangles = len(self.surface.uv), len(self.surface.triangles)
        count, parts = self.cloth_vertices, [self.surface.triangles]
        for prop in surroundings.props:
            parts.append(fans(prop.faces) + count)
            count += len(prop.vertices)
        self.triangles = np.ascontiguousarray(np.concatenate(parts), dtype=np.int32)
        self.uv = np.concatenate([self.surface.uv, np.zeros((count - self.cloth_vertices, 2))])

    def points(self, positions: npt.ArrayLike, instant: int) -> Array:
        """Return all vertices, shape (V, 3) [m], of the solver's positions (V', 3) [m] at an instant."""
        given = np.asarray(positions, dtype=np.float64)
        return np.concatenate([self.surface(given), *self.surroundings.placed(instant, given)])

    def parts(self, points: Array) -> list[Array]:
        """Split all vertices (V, 3) into those of the cloth and of each prop, (n, 3) each."""
        ends = np.cumsum([0, self.cloth_vertices, *(len(prop.vertices) for prop in self.surroundings.props)])
        return [points[begin:end] for begin, end in pairwise(ends)]

    def checked(self, positions: npt.ArrayLike) -> Array:
        """Return positions (frames, V', 3) [m], or raise a ValueError where they do not fit this cloth."""
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


def box(size: tuple[float, float, float], center: tuple[float, float, float]) -> tuple[Array, Faces]:
    """Return the corners and faces of a box."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces: Faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.asarray(center) + 0.5 * np.asarray(size) * signs, faces


HOLDER = (0.004, 0.01, 0.01)
"""Size of the clip at a corner [m]: across the cloth, and in its plane as in the simulation."""
ROD = (0.003, 0.003, 0.5)
"""Size of the rod that the clip hangs on [m]."""
_AIM = 0.05  # [m], the height that the lamp points to, under the holders


class Holders:
    """The two holders of a dragged cloth, at its upper corners [thesis, 4.2.3]; the lamp follows them."""

    def __init__(self, rest: npt.ArrayLike) -> None:
        """Find the corners of a cloth whose held edge is the last one of its rest shape (V, 2) [m]."""
        flat = np.asarray(rest, dtype=np.float64)
        low, high = flat.min(axis=0), flat.max(axis=0)
        corners = np.array([(low[0], high[1]), (high[0], high[1])])
        self._held = np.abs(flat[:, None] - corners).sum(axis=2).argmin(axis=0)
        inward = np.sign((low + high) / 2 - corners) * HOLDER[1] / 2
        self._grips = np.pad(inward, ((0, 0), (1, 0)))  # from a corner to the middle of its holder (x, y, z) [m]
        vertices, faces = _holder()
        self.props = tuple(Prop(f"holder-{n}", vertices, faces, (0.05, 0.05, 0.052), 0.45) for n in (1, 2))

    def placed(self, _instant: int, vertices: Array) -> list[Array]:
        """Move the holders with the corners that they hold."""
        return [prop.vertices + at for prop, at in zip(self.props, vertices[self._held] + self._grips, strict=True)]

    def aim(self, _instant: int, vertices: Array) -> Array:
        """Return a point below the middle of the holders."""
        return np.array([vertices[self._held, 0].mean(), 0.0, _AIM])


def _holder() -> tuple[Array, list[tuple[int, ...]]]:
    """Return a clip of one centimetre, about its middle, and the rod it hangs on."""
    boxes = [box(HOLDER, (0.0, 0.0, 0.0)), box(ROD, (0.0, 0.0, ROD[2] / 2))]
    faces = [tuple(8 * number + index for index in face) for number, (_, sides) in enumerate(boxes) for face in sides]
    return np.concatenate([corners for corners, _ in boxes]), faces
