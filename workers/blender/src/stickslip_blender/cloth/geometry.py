"""The triangles of a scene of cloth: the refined cloth, and props.

A prop may be another sheet of cloth.

The Blender scene and the rasteriser use the same triangles. Cycles sees all props grey, so the
light of the cloth depends on its albedo alone. The composer lays the colours of the props on top,
in the same way as the colours of the floor.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise, product
from typing import Protocol

import numpy as np
import numpy.typing as npt

from stickslip_blender.cloth.looks import FabricAppearance
from stickslip_blender.cloth.surface import surface
from stickslip_blender.cycles.objects import SHARP
from stickslip_blender.raster import Textures, decoded, fans

BACKGROUND, GROUND, CLOTH, PROP = range(4)
"""Codes of the segmentation, in the order of `stickslip_schemas.kinds.cloth.spec.SEGMENTS`."""

FLOOR = -0.0005
"""Height of the visible floor [m].

It lies half a thickness below the middle surface of a cloth that lies on the floor.
"""

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]
Faces = list[tuple[int, ...]]

ARC = 12  # faces of a quarter of a circle
GORE = 6
"""Faces across one gore. Bright and dark gores alternate, so a viewer can see the body turn."""
_JOINT = 1e-7  # [m]: closer vertices become one
DARK = 0.15
"""Ratio of the colour of a dark gore to the colour of a bright one."""


def rounded(core: npt.ArrayLike, radius: float) -> tuple[Array, Faces]:
    """Return the vertices (n, 3) [m] of a round body about its middle, and its convex faces.

    A round body is a core grown by a radius [m]. The core is a box of half sizes (3,) [m], and each
    half size may be 0. For example, the core of a ball is a point, the core of a capsule is a
    segment, and the core of a rounded box is a box. The mesh is the mesh of a ball, pulled apart
    between its eight octants.
    """
    quarter = np.linspace(0.0, 0.5 * np.pi, ARC + 1)
    polar = np.concatenate([quarter, quarter + 0.5 * np.pi])
    azimuth = np.concatenate([quarter + side * 0.5 * np.pi for side in range(4)])
    # The azimuth of the middle of each octant gives the axes along which its vertices are pulled.
    middle = np.repeat(0.25 * np.pi + 0.5 * np.pi * np.arange(4), ARC + 1)
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    direction = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    octant = np.empty_like(direction)
    octant[..., 0] = np.sign(np.cos(middle))
    octant[..., 1] = np.sign(np.sin(middle))
    octant[..., 2] = np.repeat([1.0, -1.0], ARC + 1)[:, None]
    vertices = (radius * direction + np.asarray(core, dtype=np.float64) * octant).reshape(-1, 3)

    # Make quadrilaterals between neighbouring rings. The edges of the octants are doubled, so the
    # faces between them have no area if the body has no core.
    rings, around = p.shape
    faces: Faces = []
    for ring in range(rings - 1):
        for place in range(around):
            left = ring * around + place
            right = ring * around + (place + 1) % around
            faces.append((left, left + around, right + around, right))

    # The poles are pulled apart to the corners of a flat face.
    corners = [side * (ARC + 1) for side in range(4)]
    return vertices, [
        *faces,
        tuple(corners),
        tuple((rings - 1) * around + corner for corner in reversed(corners)),
    ]


def gores(color: Array, count: int) -> Array:
    """Return a colour for each face of a round body, (count, 3).

    Bright and dark gores alternate.
    """
    around = 4 * (ARC + 1)
    place = np.arange(count) % around
    within = place % (ARC + 1) // GORE  # a face between octants belongs to the gore before
    dark = (np.minimum(within, ARC // GORE - 1) + place // (ARC + 1) * (ARC // GORE)) % 2 == 1
    return np.where(dark[:, None], DARK * color, color)


def box(
    size: tuple[float, float, float], center: tuple[float, float, float]
) -> tuple[Array, Faces]:
    """Return the vertices (8, 3) and faces of a box, with sides parallel to the axes [m]."""
    signs = np.array(list(product((-1, 1), repeat=3)))
    faces: Faces = [
        (0, 1, 3, 2),
        (4, 6, 7, 5),
        (0, 4, 5, 1),
        (2, 3, 7, 6),
        (0, 2, 6, 4),
        (1, 5, 7, 3),
    ]
    return np.asarray(center) + 0.5 * np.asarray(size) * signs, faces


def square(normal: npt.ArrayLike, side: float) -> tuple[Array, Faces]:
    """Return a square perpendicular to a normal (3,), for a plane that is not the floor."""
    n = np.asarray(normal, dtype=np.float64) / np.linalg.norm(normal)
    u = np.cross(n, np.eye(3)[np.abs(n).argmin()])
    u /= np.linalg.norm(u)
    v = np.cross(n, u)
    return 0.5 * side * np.stack([-u - v, u - v, u + v, v - u]), [(0, 1, 2, 3)]


def tiled(vertices: Array, faces: Faces, side: float) -> tuple[Array, Faces, npt.NDArray[np.int64]]:
    """Cut quadrilaterals into tiles of at most a side [m].

    Also return the number of the original face of each tile.

    Vertices at the same place become one vertex, so a skin has no seams. The rasteriser leaves out
    any face that reaches behind the camera. Without tiles, a large face would vanish as a whole.
    """
    points = [vertices]
    pieces: Faces = []
    owners: list[int] = []
    count = len(vertices)
    for number, face in enumerate(faces):
        # The longer of two opposite edges gives the number of tiles.
        a, b, c, d = vertices[list(face)]
        across = max(1, int(np.ceil(max(np.linalg.norm(b - a), np.linalg.norm(c - d)) / side)))
        along = max(1, int(np.ceil(max(np.linalg.norm(d - a), np.linalg.norm(c - b)) / side)))
        if across == along == 1:
            pieces.append(face)
            owners.append(number)
            continue

        # Use bilinear coordinates for a grid of vertices over the quadrilateral.
        u, v = (
            line[..., None]
            for line in np.mgrid[0 : across + 1, 0 : along + 1] / np.array([[[across]], [[along]]])
        )
        points.append((((1 - u) * a + u * b) * (1 - v) + ((1 - u) * d + u * c) * v).reshape(-1, 3))
        row = along + 1
        grid = count + np.arange((across + 1) * row).reshape(across + 1, row)
        corners = grid[:-1, :-1].ravel().tolist()
        pieces += [(corner, corner + row, corner + row + 1, corner + 1) for corner in corners]
        owners += [number] * len(corners)
        count += len(points[-1])

    # The grids of neighbouring faces share vertices. Equal positions become one vertex.
    candidates = np.concatenate(points)
    _, first, joint = np.unique(
        np.round(candidates / _JOINT), axis=0, return_index=True, return_inverse=True
    )
    rings = [tuple(dict.fromkeys(joint.ravel()[list(piece)].tolist())) for piece in pieces]

    # A face between doubled edges has shrunk to a line or a point. Remove it.
    solid = [number for number, ring in enumerate(rings) if len(ring) > 2]
    return candidates[first], [rings[number] for number in solid], np.array(owners)[solid]


@dataclass(frozen=True)
class Print:
    """The print of a prop that is a sheet of cloth."""

    uv: Array
    """Texture coordinates of the vertices in [0, 1], shape (n, 2)."""
    picture: npt.NDArray[np.uint8]
    """The picture with the grain of the fabric, 8-bit sRGB, shape (size, size, 3)."""
    look: FabricAppearance


@dataclass(frozen=True)
class Prop:
    """An object beside the cloth."""

    name: str
    vertices: Array
    """Vertices in the axes of the prop, shape (n, 3) [m]."""
    faces: Faces
    """Faces as convex polygons."""
    colors: Array
    """Linear colour of each face (n, 3), or of all faces (1, 3).

    A sheet has the colours of its picture.
    """
    roughness: float
    segment: int = PROP
    """Code of the prop in the segmentation."""
    sheet: Print | None = None

    @cached_property
    def grey(self) -> float:
        """The albedo that Cycles sees: the mean of the colours, at least 0.01."""
        colors = self.colors if self.sheet is None else decoded(self.sheet.picture)
        return max(float(colors.mean()), 0.01)

    @property
    def tints(self) -> npt.NDArray[np.float32]:
        """Colour of each triangle over `grey`, shape (T, 3).

        A sheet has 0 here, because its picture has the colour.
        """
        corners = [len(face) - 2 for face in self.faces]
        if self.sheet is not None:
            return np.zeros((sum(corners), 3), dtype=np.float32)
        each = np.broadcast_to(self.colors / self.grey, (len(corners), 3))
        return np.repeat(each, corners, axis=0).astype(np.float32)


class Surroundings(Protocol):
    """The props of a scene, and their places."""

    props: tuple[Prop, ...]
    """The props, with sheets of cloth first."""
    floor: float | None
    """Height of the visible floor [m], or None if the scene has no floor."""
    ground: int
    """Code of the floor in the segmentation."""
    segment: int
    """Code of the cloth in the segmentation."""

    def placed(self, instant: int, vertices: Array) -> list[Array]:
        """Return the vertices of each prop (n, 3) [m] at an instant.

        The cloth has the vertices (V, 3) [m].
        """


@dataclass(frozen=True)
class Printed:
    """A sheet of cloth among the props, with the data to look up its colour."""

    triangles: slice
    """The triangles of the sheet among the triangles of all props."""
    textures: Textures
    grey: float


class Geometry:
    """The triangles of a scene, from the solver's positions."""

    triangles: Indices
    """Triangles of the cloth, then triangles of the props, shape (T, 3)."""
    cloth_triangles: int
    """Number of triangles that belong to the cloth."""
    uv: Array
    """Texture coordinates of all vertices, 0 for vertices without a texture."""
    segments: npt.NDArray[np.uint8]
    """Code of each triangle in the segmentation, shape (T,)."""
    has_uv: npt.NDArray[np.bool_]
    """Whether each triangle is cloth, shape (T,)."""
    shaded: Indices
    """Vertices for shading, shape (S,).

    A vertex of a prop occurs once for each smooth skin that meets there.
    """
    shaded_triangles: Indices
    """Triangles by their places in `shaded`, shape (T, 3).

    Two triangles share a corner only if they belong to one skin.
    """
    tints: npt.NDArray[np.float32]
    """Tint of each triangle of the props, and a row of zeros at the end, shape (T' + 1, 3)."""
    printed: tuple[Printed, ...]
    """The sheets among the props."""

    def __init__(
        self, triangles: npt.ArrayLike, rest: npt.ArrayLike, surroundings: Surroundings
    ) -> None:
        """Prepare a mesh of triangles (T, 3) with the rest shape (V, 2) [m]."""
        self.vertices = len(np.asarray(rest))
        self.surroundings = surroundings
        self.surface = surface(triangles, rest)
        self.cloth_vertices = len(self.surface.uv)
        self.cloth_triangles = len(self.surface.triangles)
        props = surroundings.props

        # One array has all vertices, with the cloth first. The triangles of a prop therefore count
        # from the first vertex of the prop.
        sizes = np.cumsum([self.cloth_vertices, *(len(prop.vertices) for prop in props)])
        parts = [
            self.surface.triangles,
            *(fans(p.faces) + first for p, first in zip(props, sizes[:-1], strict=True)),
        ]
        self.triangles = np.ascontiguousarray(np.concatenate(parts), dtype=np.int32)

        # The rasteriser looks these values up for each vertex or triangle.
        counts = [len(part) for part in parts]
        self.uv = np.concatenate(
            [
                self.surface.uv,
                *(np.zeros((len(p.vertices), 2)) if p.sheet is None else p.sheet.uv for p in props),
            ]
        )
        self.segments = np.repeat(
            [surroundings.segment, *(p.segment for p in props)], counts
        ).astype(np.uint8)
        self.has_uv = np.repeat([True, *(p.sheet is not None for p in props)], counts)

        # Blender shades a prop smoothly except at sharp edges. The normals of the ground truth
        # follow the same rule. The cloth is one smooth skin.
        skins: list[tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]] = [
            (np.arange(self.cloth_vertices), parts[0])
        ]
        skins += [split_at_sharp_edges(p.vertices, fans(p.faces)) for p in props]
        ends = np.cumsum([0, *(len(vertices) for vertices, _ in skins)])
        self.shaded = np.concatenate(
            [v + first for (v, _), first in zip(skins, [0, *sizes[:-1]], strict=True)]
        )
        self.shaded_triangles = np.concatenate(
            [t + first for (_, t), first in zip(skins, ends[:-1], strict=True)]
        )
        self.tints = np.concatenate([*(p.tints for p in props), np.zeros((1, 3), dtype=np.float32)])

        # Each sheet among the props has a range in the triangles of all props.
        ends = np.cumsum([0, *counts[1:]])
        self.printed = tuple(
            Printed(slice(begin, end), Textures([prop.sheet.picture]), prop.grey)
            for prop, (begin, end) in zip(props, pairwise(ends.tolist()), strict=True)
            if prop.sheet is not None
        )

    def points(self, positions: npt.ArrayLike, instant: int) -> Array:
        """Return all vertices (V, 3) [m] for the solver's positions (V', 3) [m] at an instant."""
        vertices = np.asarray(positions, dtype=np.float64)
        return np.concatenate(
            [self.surface(vertices), *self.surroundings.placed(instant, vertices)]
        )

    def parts(self, points: Array) -> list[Array]:
        """Split all vertices (V, 3) into the vertices (n, 3) of the cloth and of each prop."""
        ends = np.cumsum(
            [0, self.cloth_vertices, *(len(prop.vertices) for prop in self.surroundings.props)]
        )
        return [points[begin:end] for begin, end in pairwise(ends)]

    def checked(self, positions: npt.ArrayLike) -> Array:
        """Return positions (frames, V', 3) [m].

        Raises ValueError if they do not fit this cloth.
        """
        track = np.asarray(positions, dtype=np.float64)
        if track.ndim != 3 or track.shape[1:] != (self.vertices, 3) or not np.isfinite(track).all():
            raise ValueError(
                f"positions must be finite, of shape (frames, {self.vertices}, 3); got shape "
                f"{track.shape}"
            )
        return track


def split_at_sharp_edges(vertices: Array, triangles: Indices) -> tuple[Indices, Indices]:
    """Split the vertices (V, 3) of triangles (T, 3) at edges sharper than `SHARP`.

    Blender shades a mesh in this way.

    Returns the vertices (S,) and the triangles (T, 3). A vertex occurs once for each smooth skin
    that meets there, and the triangles refer to these vertices.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)

    # Two corners that share a vertex and a smooth edge get the same label, the least of their
    # numbers. In this order, the corners of a vertex are neighbours.
    corners = triangles.ravel()
    label = np.arange(corners.size)
    order = np.argsort(corners, kind="stable")
    most_corners = int(np.bincount(corners).max())
    for _ in range(most_corners):  # a label passes along one link a round; no chain is longer
        for shift in range(1, most_corners):
            first_corner = order[:-shift]
            second_corner = order[shift:]
            is_open = (corners[first_corner] == corners[second_corner]) & (
                label[first_corner] != label[second_corner]
            )
            first_corner = first_corner[is_open]
            second_corner = second_corner[is_open]

            # Two triangles belong to one smooth skin if the angle between their normals is less
            # than SHARP.
            cosine = (normals[first_corner // 3] * normals[second_corner // 3]).sum(axis=1)
            is_smooth = cosine > np.cos(SHARP)
            first_corner = first_corner[is_smooth]
            second_corner = second_corner[is_smooth]
            least = np.minimum(label[first_corner], label[second_corner])
            np.minimum.at(label, np.concatenate([first_corner, second_corner]), np.tile(least, 2))

    # Each label is a vertex of the split skin.
    _, first, vertex = np.unique(label, return_index=True, return_inverse=True)
    return corners[first], vertex.reshape(-1, 3).astype(np.int32)


def mirrored(points: Array, floor: float) -> Array:
    """Return the mirror image of points in a floor at a height [m]."""
    image = points.copy()
    image[:, 2] = 2.0 * floor - image[:, 2]
    return image


HOLDER = (0.004, 0.01, 0.01)
"""Sides of the clip at a corner [m]: across the cloth, and in its plane as in the simulation."""
ROD = (0.003, 0.003, 0.5)
"""Sides of the rod that carries the clip [m]."""
HOLDER_COLOR = np.array([[0.05, 0.05, 0.05]])
HOLDER_ROUGHNESS = 0.45


class Holders:
    """The two holders of a dragged cloth, at its upper corners [thesis, 4.2.3]."""

    floor: float | None = FLOOR
    ground = GROUND
    segment = CLOTH

    def __init__(self, rest: npt.ArrayLike) -> None:
        """Find the held corners of a cloth from its rest shape (V, 2) [m].

        The held edge has the largest second coordinate.
        """
        flat = np.asarray(rest, dtype=np.float64)
        # The simulation holds the two vertices that are nearest to the upper corners.
        low = flat.min(axis=0)
        high = flat.max(axis=0)
        corners = np.array([(low[0], high[1]), (high[0], high[1])])
        self._held = np.abs(flat[:, None] - corners).sum(axis=2).argmin(axis=0)
        inward = np.sign((low + high) / 2 - corners) * HOLDER[1] / 2
        # Offset from a corner to the middle of its holder (x, y, z) [m]. The holder grips the
        # inside of the cloth.
        self._grips = np.pad(inward, ((0, 0), (1, 0)))

        # One prop has both the clip and its rod. The vertices of the rod follow the vertices of the
        # clip.
        clip_vertices, clip_faces = box(HOLDER, (0.0, 0.0, 0.0))
        rod_vertices, rod_faces = box(ROD, (0.0, 0.0, ROD[2] / 2))
        vertices = np.concatenate([clip_vertices, rod_vertices])
        faces = list(clip_faces)
        faces += [tuple(len(clip_vertices) + index for index in face) for face in rod_faces]
        self.props = tuple(
            Prop(f"holder-{n}", vertices, faces, HOLDER_COLOR, HOLDER_ROUGHNESS) for n in (1, 2)
        )

    def placed(self, _instant: int, vertices: Array) -> list[Array]:
        return [
            prop.vertices + at
            for prop, at in zip(self.props, vertices[self._held] + self._grips, strict=True)
        ]
