"""What stands on a stage of cloth, as triangles: the cloth that is seen, and the things about it.

The scene in Blender and the rasteriser are both made of it, so that they see the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
import numpy.typing as npt

from stickslip_blender.surface import Surface

FLOOR = -0.0005
"""Height at which the floor is seen [m]: half a thickness below the middle surface of a cloth that lies on it."""

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]
Faces = list[tuple[int, ...]]


@dataclass(frozen=True)
class Prop:
    """A thing on the stage."""

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


class Set(Protocol):
    """What a scene puts on the stage besides the cloth, and where everything is."""

    props: tuple[Prop, ...]

    def placed(self, instant: int, vertices: Array) -> list[Array]:
        """Return the vertices of each prop (n, 3) [m] at an instant, with the cloth at vertices (V, 3) [m]."""

    def aim(self, instant: int, vertices: Array) -> Array:
        """Return the point that the lamp follows (3,) [m]."""


class Geometry:
    """The stage's triangles, from the solver's positions."""

    triangles: Indices
    """Shape (T, 3): those of the cloth, then those of the props."""
    cloth_triangles: int
    """How many of them are the cloth's."""
    uv: Array
    """Texture coordinates of all vertices; those of the props are 0."""

    def __init__(self, triangles: npt.ArrayLike, rest: npt.ArrayLike, stage: Set) -> None:
        """Prepare a mesh of triangles (T, 3) with the rest shape (V, 2) [m]."""
        self.vertices = len(np.asarray(rest))
        self.stage = stage
        self.surface = Surface(triangles, rest)
        self.cloth_vertices, self.cloth_triangles = len(self.surface.uv), len(self.surface.triangles)
        count, parts = self.cloth_vertices, [self.surface.triangles]
        for prop in stage.props:
            fans = [(face[0], b, c) for face in prop.faces for b, c in pairwise(face[1:])]
            parts.append(np.array(fans, dtype=np.int32) + count)
            count += len(prop.vertices)
        self.triangles = np.ascontiguousarray(np.concatenate(parts), dtype=np.int32)
        self.uv = np.concatenate([self.surface.uv, np.zeros((count - self.cloth_vertices, 2))])

    def points(self, positions: npt.ArrayLike, instant: int) -> Array:
        """Return all vertices, shape (V, 3) [m], of the solver's positions (V', 3) [m] at an instant."""
        given = np.asarray(positions, dtype=np.float64)
        return np.concatenate([self.surface(given), *self.stage.placed(instant, given)])

    def of_props(self, points: Array) -> list[Array]:
        """Return the part of all vertices (V, 3) that is each prop's (n, 3)."""
        ends = np.cumsum([self.cloth_vertices, *(len(prop.vertices) for prop in self.stage.props)])
        return [points[begin:end] for begin, end in pairwise(ends)]

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


def box(size: tuple[float, float, float], center: tuple[float, float, float]) -> tuple[Array, Faces]:
    """Return the corners and faces of a box."""
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    faces: Faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.asarray(center) + 0.5 * np.asarray(size) * signs, faces
