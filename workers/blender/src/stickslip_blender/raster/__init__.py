"""A rasteriser: a camera's view of a mesh, without light.

Cycles gives the light. Albedo at texture edges, silhouettes, depth and other ground truth are
geometry, and the rasteriser computes them at a far lower cost. It finds the triangle that each
sample of an image sees, interpolates values there, and gives the albedo of many textures. The
compiled part is `_raster`. raster/raster.hpp defines the places of the samples and the lookup of
textures.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.raster import _raster

GRID = 12
"""Samples across a pixel, and down.

Silhouettes are then within 0.0005 of their coverage.
"""

_BAND_SAMPLES = 2**24
"""Samples of a window that are looked up at once: they take 200 MB of memory."""

_LANES = 8  # channels are padded to a multiple of this

_LINEAR = np.array([_raster.decoded(level / 255.0) for level in range(256)], dtype=np.float32)

Points = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]


@dataclass(frozen=True)
class Window:
    """A part of a frame: columns [left, right), rows [top, bottom) [px], row 0 on top."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def area(self) -> int:
        return max(self.right - self.left, 0) * max(self.bottom - self.top, 0)

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the window in a frame (height, width, ...)."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def times(self, fine: int) -> "Window":
        """Return the same part of a frame with fine x fine pixels for each pixel."""
        return Window(fine * self.left, fine * self.top, fine * self.right, fine * self.bottom)

    def bands(self, grid: int) -> Iterator["Window"]:
        """Yield the window in bands of rows, each of at most `_BAND_SAMPLES` samples or one row.

        A pixel has grid x grid samples.
        """
        samples = max(self.right - self.left, 1) * grid**2
        rows = max(_BAND_SAMPLES // samples, 1)
        for top in range(self.top, max(self.bottom, self.top + 1), rows):
            yield replace(self, top=top, bottom=min(top + rows, self.bottom))

    @property
    def place(self) -> tuple[int, int, int, int]:
        """Left, top, width and height, as the compiled rasteriser takes them."""
        return self.left, self.top, self.right - self.left, self.bottom - self.top


@dataclass(frozen=True)
class VisibleTriangles:
    """The triangle that each sample of a window sees."""

    points: Points
    """Projected vertices: column, row [px] and depth [scene units], shape (V, 3)."""
    triangles: Indices
    """Corners of the triangles, shape (T, 3)."""
    window: Window
    grid: int
    """Samples across a pixel."""
    triangle: Indices
    """Triangle of each sample, or -1 for no triangle, shape (grid height, grid width)."""
    places: Points | None = None
    """Columns and rows of the samples [px], (height, width, 2).

    None stands for the middles of the pixels of the window.
    """

    def share_below(self, end: int) -> npt.NDArray[np.float32]:
        """Return the share of samples that see a triangle before `end`, (height, width)."""
        hit = (self.triangle >= 0) & (self.triangle < end)
        rows = self.triangle.shape[0] // self.grid
        columns = self.triangle.shape[1] // self.grid
        share: npt.NDArray[np.float32] = hit.reshape(rows, self.grid, columns, self.grid).mean(
            axis=(1, 3), dtype=np.float32
        )
        return share

    def looked_up(self, places: Points) -> "VisibleTriangles":
        """Return the view at positions (height, width, 2) [px] of the frame, with a grid of 1.

        Each position gets the triangle of the nearest sample.
        """
        near = np.rint(places).astype(int) - (self.window.left, self.window.top)
        return replace(self, triangle=self.triangle[near[..., 1], near[..., 0]], places=places)

    def at_centers(self, values: npt.ArrayLike, fill: float = 0.0) -> npt.NDArray[np.float64]:
        """Interpolate values of vertices (V, k) in perspective at the samples.

        Samples that see nothing get `fill`. The grid must have one sample a pixel. Returns shape
        (height, width, k).
        """
        if self.grid != 1:
            raise ValueError(
                f"grid must be 1, a sample in the middle of each pixel; got {self.grid}"
            )
        vertex_values = np.asarray(values, dtype=np.float64)
        result = np.full((*self.triangle.shape, vertex_values.shape[1]), fill)
        rows, columns = np.nonzero(self.triangle >= 0)
        corners = self.triangles[self.triangle[rows, columns]]
        middles = np.column_stack([columns + self.window.left, rows + self.window.top])
        place = middles if self.places is None else self.places[rows, columns]
        weights = barycentric(self.points[corners][..., :2], place) / self.points[corners][..., 2]
        weights /= weights.sum(axis=1, keepdims=True)
        result[rows, columns] = np.einsum("nk,nkx->nx", weights, vertex_values[corners])
        return result


def barycentric(corners: Points, places: npt.NDArray[Any]) -> Points:
    """Return the weights (n, 3) of flat triangles' corners (n, 3, 2) at positions (n, 2).

    Corners and positions are in the image.
    """
    a, b, c = (corners[:, k] for k in range(3))

    def area(p: npt.NDArray[Any], q: npt.NDArray[Any], r: npt.NDArray[Any]) -> npt.NDArray[Any]:
        first = q - p
        second = r - p
        return np.asarray(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])

    parts = np.stack([area(places, b, c), area(a, places, c), area(a, b, places)], axis=1)
    return np.asarray(parts / area(a, b, c)[:, None])


def projected(camera: Camera, points: npt.ArrayLike) -> Points:
    """Project world points (V, 3) to columns, rows [px] and depths [scene units], shape (V, 3)."""
    pixels, depth = camera.project(points)
    return np.ascontiguousarray(np.concatenate([pixels, depth[:, None]], axis=1))


def scaled(camera: Camera, factor: float) -> Camera:
    """Return a camera whose frame has `factor` times as many pixels along each side.

    The numbers are rounded to whole pixels.
    """
    size = {name: round(factor * getattr(camera, name)) for name in ("width", "height")}
    focal = {name: factor * getattr(camera, name) for name in ("fx", "fy")}
    centre = {name: factor * (getattr(camera, name) + 0.5) - 0.5 for name in ("cx", "cy")}
    return camera.model_copy(update=size | focal | centre)


def window_about(points: Points, camera: Camera, margin: int = 1) -> Window:
    """Return the part of the frame that contains projected points, with a margin around it [px]."""
    places = points[np.isfinite(points[:, 0]), :2]  # the others are behind the camera
    if not len(places):
        return Window(0, 0, 0, 0)
    low = np.floor(places.min(axis=0)) - margin
    high = np.ceil(places.max(axis=0)) + margin + 1
    left, top = np.maximum(low, 0).astype(int)
    right, bottom = np.minimum(high, (camera.width, camera.height)).astype(int)
    return Window(int(left), int(top), int(right), int(bottom))


def decoded(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Return a picture, 8-bit sRGB, as linear light [IEC 61966-2-1]."""
    return _LINEAR[picture]


def fans(faces: Sequence[Sequence[int]]) -> Indices:
    """Return convex polygons as fans of triangles, shape (T, 3)."""
    triangles: list[tuple[int, int, int]] = []
    for face in faces:
        triangles += [(face[0], b, c) for b, c in pairwise(face[1:])]
    return np.array(triangles, dtype=np.int32)


def see(points: Points, triangles: Indices, window: Window, grid: int = GRID) -> VisibleTriangles:
    """Find the nearest of the triangles (T, 3) of projected points at each sample of a window.

    A triangle that reaches behind the camera is invisible.
    """
    behind = ~(points[:, 2] > 0.0)
    if behind.any():
        points = np.where(behind[:, None], (0.0, 0.0, 1.0), points)
        triangles = np.where(
            behind[triangles].any(axis=1, keepdims=True), triangles[:1, :1], triangles
        )
    return VisibleTriangles(
        points, triangles, window, grid, _raster.visible(points, triangles, window.place, grid)
    )


class Textures:
    """Pictures of one size, packed so that one lookup serves all of them."""

    def __init__(self, pictures: Sequence[npt.NDArray[np.uint8]]) -> None:
        """Pack pictures (size, size, 3), 8-bit sRGB, row 0 at v = 0."""
        shapes = {picture.shape for picture in pictures}
        if len(shapes) != 1 or (shape := shapes.pop()) != (shape[0], shape[0], 3):
            raise ValueError(
                f"textures must be pictures of one shape (size, size, 3); got {sorted(shapes)}"
            )
        self.count = len(pictures)
        channels = -(-3 * self.count // _LANES) * _LANES
        self.texels = np.zeros((shape[0], shape[0], channels), dtype=np.float32)
        for number, picture in enumerate(pictures):
            self.texels[..., 3 * number : 3 * number + 3] = picture / np.float32(255)


@dataclass(frozen=True)
class Albedo:
    """The cloth in the pixels of a window."""

    coverage: npt.NDArray[np.float32]
    """Share of each pixel that shows cloth, shape (height, width)."""
    mean: npt.NDArray[np.float32]
    """Linear albedo of the visible cloth, 0 elsewhere, shape (height, width, textures, 3)."""
    hits: npt.NDArray[np.int32]
    """Number of samples that see each of the cloth's triangles."""
    overall: npt.NDArray[np.float32]
    """Mean albedo of all visible cloth, shape (textures, 3)."""
    area: float
    """Sum of the areas of the cloth's triangles, each without the others in front [pixels]."""


def see_albedo(
    visible: VisibleTriangles, uv: npt.NDArray[np.float64], textures: Textures, cloth: int
) -> Albedo:
    """Average the textures over the visible part of the first `cloth` triangles.

    `uv` are texture coordinates (V, 2) in [0, 1].
    """
    packed = textures.texels, textures.count, visible.window.place, visible.grid
    return Albedo(
        *_raster.albedo(visible.triangle, visible.points, visible.triangles, uv, cloth, *packed)
    )


def albedo_of_window(
    points: Points,
    triangles: Indices,
    window: Window,
    grid: int,
    *,
    uv: npt.NDArray[np.float64],
    textures: Textures,
    cloth: int,
) -> Albedo:
    """Look up what a window sees of the first `cloth` triangles, band by band.

    The arguments are those of `see` and `see_albedo`. Bands bound the memory.
    """
    sights: list[Albedo] = []
    for band in window.bands(grid):
        visible = see(points, triangles, band, grid)
        sights.append(see_albedo(visible, uv, textures, cloth))
    if len(sights) == 1:
        return sights[0]
    # The mean of all visible cloth is that of the bands, by the samples that see cloth.
    weights = np.array([float(sight.hits.sum()) for sight in sights])
    share = weights / max(weights.sum(), 1.0)
    overall = sum(
        (part * sight.overall for part, sight in zip(share, sights, strict=True)),
        np.zeros_like(sights[0].overall, dtype=np.float64),
    )
    return Albedo(
        coverage=np.concatenate([sight.coverage for sight in sights]),
        mean=np.concatenate([sight.mean for sight in sights]),
        hits=np.sum([sight.hits for sight in sights], axis=0, dtype=np.int32),
        overall=np.asarray(overall, dtype=np.float32),
        area=sights[0].area,
    )


def coverage_of_window(
    points: Points, triangles: Indices, window: Window, grid: int, end: int
) -> npt.NDArray[np.float32]:
    """Return the share of each pixel that sees a triangle before `end`, band by band."""
    bands = window.bands(grid)
    return np.concatenate([see(points, triangles, band, grid).share_below(end) for band in bands])
