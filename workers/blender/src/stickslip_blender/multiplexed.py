"""One trace for many textures.

The cloth is traced once with the base colour ALBEDOS. Lamp and floor are grey, so red, green and blue are three samples
of the light that a pixel sends to the camera, as a function of the cloth's albedo a:

    L(a) = S + D a + I a^2        S: gloss and what is not cloth; D: light that cloth scattered once; I: twice

A texture has the albedo A(p) at pixel p, from the rasteriser, and its picture is

    L(p) = S + (D + I m) A(p)     m: mean albedo of the cloth in sight, for light comes from elsewhere on the cloth

in linear light, for each of the texture's colours. Off the cloth D is light that the cloth threw there: A is m, or what
a floor that mirrors shows of the cloth, blurred as much as its roughness does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from stickslip_schemas.cameras import Camera

from stickslip_blender.geometry import FLOOR, Geometry, mirrored
from stickslip_blender.raster import Albedo, Seen, Textures, Window, projected, see, see_albedo, window_about
from stickslip_blender.substrates import Substrate

ALBEDOS = (0.0, 0.5, 0.9)
"""The cloth's base colour in a trace."""

_MIRROR_GRID = 8
_LOBE = 1.9  # radius of a box, twice applied, over the width of the lobe that it stands for; compared with Cycles
_DIELECTRIC = 0.06  # what a floor that is no metal reflects, at the angles of our cameras
_LEVELS = 65536  # of the table that encodes linear light

Floats = npt.NDArray[np.float32]


def _encoding() -> npt.NDArray[np.uint8]:
    light = np.arange(_LEVELS) / (_LEVELS - 1)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * srgb).astype(np.uint8)


_ENCODED = _encoding()


def encode(light: Floats) -> npt.NDArray[np.uint8]:
    """Return linear light as 8-bit sRGB [IEC 61966-2-1], clipped to [0, 1]."""
    scaled = np.clip(light, 0.0, 1.0)
    scaled *= _LEVELS - 1
    scaled += 0.5
    coded: npt.NDArray[np.uint8] = _ENCODED[scaled.astype(np.uint16)]
    return coded


def separate(trace: npt.NDArray[np.float16]) -> tuple[Floats, Floats, Floats]:
    """Return S, D and I (height, width) of a trace (height, width, 3)."""
    at_0, at_1, at_2 = (trace[..., k].astype(np.float32) for k in range(3))
    _, a, b = ALBEDOS
    to_a, to_b = (at_1 - at_0) / a, (at_2 - at_0) / b
    twice = (to_b - to_a) / (b - a)
    return at_0, _single(to_a - a * twice), _single(twice)


def _single(values: npt.ArrayLike) -> Floats:
    """Return values as single floats, which is what they are at run time; the types of numpy do not know."""
    return np.asarray(values, dtype=np.float32)


@dataclass(frozen=True)
class Composed:
    """One frame of all textures."""

    pictures: npt.NDArray[np.uint8]
    """8-bit sRGB, shape (textures, height, width, 3)."""
    frame_share: float
    """Share of the frame that is cloth."""
    visible_share: float
    """Share of the cloth, its area taken as it is turned to the camera, that nothing hides."""


class Composer:
    """Makes pictures of textures from traces of one cloth."""

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry

    def compose(
        self,
        trace: npt.NDArray[np.float16],
        points: npt.NDArray[np.float64],
        camera: Camera,
        substrate: Substrate,
        floor: Floats,
        textures: Textures,
    ) -> Composed:
        """Compose one frame's trace (height, width, 3) with all textures.

        Points: all vertices of the stage at that instant (V, 3) [m]; floor: as `floor_factor` returns it.
        """
        S, D, I = separate(trace)  # noqa: E741  (the formula's name)
        seen = see(projected(camera, points), self._geometry.triangles, self._window(points, camera))
        sight = see_albedo(seen, self._geometry.uv, textures, self._geometry.cloth_triangles)
        weight = sight.coverage.sum()
        mean = np.einsum("hw,hwnc->nc", sight.coverage, sight.mean) / np.maximum(weight, np.float32(1e-6))
        albedo = np.empty((*S.shape, textures.count, 3), dtype=np.float32)
        albedo[:] = mean
        if substrate.mirrors:
            self._mirror(albedo, points, camera, substrate, textures)
        _lay_over(albedo, sight, seen.window, _reflectance(substrate))
        cover = np.zeros(S.shape, dtype=np.float32)
        cover[seen.window.slices] = sight.coverage
        factor = 1.0 + (1.0 - cover[..., None]) * (floor - 1.0)
        light: Floats = _single(albedo * (D[..., None, None] + I[..., None, None] * mean))
        light += S[..., None, None]
        light *= _single(factor)[:, :, None]
        share = self._in_sight(seen, sight)
        return Composed(np.moveaxis(encode(light), 2, 0), float(weight) / S.size, share)

    def _in_sight(self, seen: Seen, sight: Albedo) -> float:
        """Return the share of the cloth's area, as the camera would see it without anything in its way, that is seen.

        A triangle's own area in the image is what its samples are compared with.
        """
        corners = seen.points[self._geometry.surface.triangles][..., :2]
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        area = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        return float(min(sight.hits.sum() / seen.grid**2 / max(area.sum(), 1e-9), 1.0))

    def on_floor(
        self, light: npt.NDArray[np.float16], points: npt.NDArray[np.float64], camera: Camera, floor: Floats
    ) -> Floats:
        """Give the floor of a frame that was rendered directly (height, width, 3) its marks and colour."""
        window = self._window(points, camera)
        seen = see(projected(camera, points), self._geometry.triangles, window)
        cover = np.zeros(light.shape[:2], dtype=np.float32)
        cover[window.slices] = seen.share_below(self._geometry.cloth_triangles)
        return _single(light * (1.0 + (1.0 - cover[..., None]) * (floor - 1.0)))

    def _window(self, points: npt.NDArray[np.float64], camera: Camera) -> Window:
        return window_about(projected(camera, points[: self._geometry.cloth_vertices]), camera)

    def _mirror(
        self,
        albedo: Floats,
        points: npt.NDArray[np.float64],
        camera: Camera,
        substrate: Substrate,
        textures: Textures,
    ) -> None:
        """Write into `albedo` what the floor shows of the cloth where it mirrors it."""
        cloth = self._geometry.cloth_triangles
        below = projected(camera, mirrored(points))
        window = window_about(below[: self._geometry.cloth_vertices], camera, margin=12)
        if window.is_empty:
            return
        seen = see(below, self._geometry.triangles, window, _MIRROR_GRID)
        sight = see_albedo(seen, self._geometry.uv, textures, cloth)
        if not sight.coverage.any():
            return
        beyond = _beyond_floor(see(below, self._geometry.triangles, window, 1), camera)
        shown = sight.coverage[..., None]
        around = _blurred(np.concatenate([shown, shown * beyond[..., None]], axis=2), np.full(beyond.shape, 6), None)
        path = around[..., 1] / np.maximum(around[..., 0], 1e-6)
        # Seen from where the mirrored ray meets the floor, a lobe of microfacets of width roughness^2 is narrower
        # across the plane of incidence than in it, by the sine of the angle at which the camera looks down.
        down = _LOBE * camera.fy * substrate.roughness**2 * path
        across = np.rint(down * -np.asarray(camera.rotation)[2, 2]).astype(int)
        flat = (shown[..., None] * sight.mean).reshape(*beyond.shape, -1)
        blurred = _blurred(np.concatenate([shown, flat], axis=2), np.rint(down).astype(int), across)
        share = blurred[..., :1]
        part = albedo[window.slices]
        known = np.minimum(share / 0.02, 1.0)[..., None]
        color = (blurred[..., 1:] / np.maximum(share, 1e-6)).reshape(part.shape)
        part += known * (color - part)


def _lay_over(albedo: Floats, sight: Albedo, window: Window, reflectance: float) -> None:
    """Let the cloth in sight cover what the floor shows, in proportion to how bright both are."""
    part = albedo[window.slices]
    cover = sight.coverage[..., None, None]
    share = cover / np.maximum(cover + (1.0 - cover) * np.float32(reflectance), 1e-6)
    part += share * (sight.mean - part)


def _reflectance(substrate: Substrate) -> float:
    return substrate.albedo if substrate.metallic > 0.5 else _DIELECTRIC


def _beyond_floor(seen: Seen, camera: Camera) -> npt.NDArray[np.float64]:
    """Return how far behind the floor a mirrored thing appears, over its depth, (height, width); 0 where none is."""
    depth = seen.at_centers(seen.points[:, 2:])[..., 0]
    window = seen.window
    rows, columns = np.mgrid[window.top : window.bottom, window.left : window.right]
    ray = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(rows.shape)], axis=-1)
    down = (ray @ np.asarray(camera.rotation))[..., 2]
    floor = (FLOOR - camera.position[2]) / np.where(down < -1e-6, down, -1e-6)
    share: npt.NDArray[np.float64] = np.where(depth > 0.0, 1.0 - floor / np.maximum(depth, 1e-6), 0.0)
    return np.clip(share, 0.0, 1.0)


def _blurred(
    values: npt.NDArray[np.floating], down: npt.NDArray[np.integer], across: npt.NDArray[np.integer] | None
) -> npt.NDArray[np.float64]:
    """Return values (height, width, k), blurred about each pixel by radii of its own (height, width) [px].

    Twice the mean over a box, each from a summed-area table [Crow 1984].
    """
    height, width, count = values.shape
    rows, columns = np.indices(down.shape)
    across = down if across is None else across
    top, bottom = np.maximum(rows - down, 0), np.minimum(rows + down + 1, height)
    left, right = np.maximum(columns - across, 0), np.minimum(columns + across + 1, width)
    area = ((2 * down + 1) * (2 * across + 1))[..., None]
    table = np.zeros((height + 1, width + 1, count))
    result = np.asarray(values, dtype=np.float64)
    for _ in range(2):
        np.cumsum(np.cumsum(result, axis=0), axis=1, out=table[1:, 1:])
        result = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
        result /= area
    return result
