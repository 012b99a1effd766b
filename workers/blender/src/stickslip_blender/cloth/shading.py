"""One shading for many textures.

The cloth is rendered once with the base colours CAMERA_ALBEDOS and ELSEWHERE. Lamp and floor are
grey, so red, green and blue are three samples of the light that a pixel sends to the camera. This
light is a function of the cloth's albedo at the pixel, a, and elsewhere, m:

    L(a, m) = S + (D + I m) a

S is the gloss, including the gloss of light from other cloth. D is the light scattered once, and I
is the light scattered twice.

A texture has the albedo A(p) at pixel p, from the rasteriser. Its picture is L(A(p), m) with the
mean albedo m of the visible cloth, in linear light, for each of the texture's colours. The cloth is
rendered with FINE x FINE pixels in each pixel of a picture. If light and print change within a
pixel, the mean of their products differs from the product of their means.

In pixels without cloth, L is linear in the albedo of the light that the cloth threw there. This
albedo is m, or the mirror image of the cloth in a floor that mirrors, blurred as much as the
roughness of the floor does. Marks of the floor and colours of props lie on top, as factors of their
light: everything except the cloth is grey in Cycles.

Each level of a picture is within TOLERANCE of the exact value. Within this limit, the composer
keeps the pixels of the frame before, which makes clips 6 % smaller. It also makes the colours of
grey equal, which makes clips a tenth smaller.
"""

from dataclasses import replace
from itertools import product

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cloth.geometry import Geometry, mirrored
from stickslip_blender.cloth.looks import Substrate
from stickslip_blender.raster import (
    GRID,
    Albedo,
    Textures,
    VisibleTriangles,
    Window,
    _raster,
    albedo_of_window,
    coverage_of_window,
    projected,
    scaled,
    see,
    see_albedo,
    window_about,
)

CAMERA_ALBEDOS = (0.0, 0.6, 0.6)
ELSEWHERE = (0.3, 0.3, 0.05)
"""Base colours of the cloth in a shading, for rays of the camera and for other rays."""

FINE = 2  # pixels of a shading across a pixel of a picture, and down
TOLERANCE: int = _raster.TOLERANCE
"""Largest difference of a pixel of a clip from its exact value [8-bit levels].

raster/raster.hpp sets it.
"""

_MIRROR_GRID = 8
_PROP_GRID = 3
# Ratio of the radius of a box, applied twice, to the width of the lobe that it stands for. The
# value comes from a comparison with Cycles.
_LOBE = 1.9
_SURE_COVERAGE = 0.02  # coverage by mirrored cloth from which its colour counts in full
_PATH_BLUR = 6.0  # width of the mean of the lengths of mirrored paths [px of the default size]
_MIRROR_MARGIN = 12  # about a mirror image, for its blur [px of the default size]

Floats = npt.NDArray[np.float32]


class Composer:
    """Composes pictures of textures from shadings of one cloth."""

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry

    def compose(
        self,
        shading: npt.NDArray[np.float16],
        points: npt.NDArray[np.float64],
        camera: Camera,
        substrate: Substrate,
        floor: Floats,
        textures: Textures,
        pictures: npt.NDArray[np.uint8],
        *,
        enlargement: float = 1.0,
    ) -> tuple[float, float]:
        """Compose a frame's shading with all textures, into `pictures`.

        The shading is (FINE height, FINE width, 3). `points` are all vertices of the scene at that
        instant (V, 3) [m], and `floor` has the form that `floor_factor` returns. `pictures` has the
        pictures of the frame before, or zeros, 8-bit sRGB, shape (textures, height, width, 3).
        `enlargement` is the shorter side of the pictures over that of the default resolution.

        Returns the share of the frame that is cloth, and the share of the cloth that is visible.
        The area of the cloth is its area as the camera sees it, with nothing in front.
        """
        # Find the triangle that each finer pixel sees, and the mean albedo of the cloth there in
        # each texture.
        window = self._window(points, camera).times(FINE)
        parts = scaled(camera, FINE)
        sight = self._albedo(projected(parts, points), window, GRID // FINE, textures)
        colors = 3 * textures.count

        # On a floor that mirrors, the light from the cloth has the colour of its mirror image. On
        # other floors, it has the mean colour of the visible cloth.
        reflected = np.empty((0, 0, colors), dtype=np.float32)
        around = Window(0, 0, 0, 0)
        if substrate.mirrors and self._geometry.surroundings.floor is not None:
            reflected, around = self._mirror(
                sight.overall, points, camera, substrate, textures, enlargement
            )
        _raster.compose(
            np.ascontiguousarray(shading).view(np.uint16),
            (CAMERA_ALBEDOS[1], *ELSEWHERE[1:]),
            sight.overall.ravel(),
            sight.coverage,
            sight.mean.reshape(*sight.coverage.shape, colors),
            window.place,
            reflected,
            around.place,
            self._tinted(floor, points, camera),
            pictures,
        )
        # Divide the samples of visible cloth by the samples of its projected area.
        frame = parts.width * parts.height
        visible = sight.hits.sum() / (GRID // FINE) ** 2 / max(sight.area, 1e-9)
        return float(sight.coverage.sum()) / frame, float(min(visible, 1.0))

    def floor_factor(
        self, points: npt.NDArray[np.float64], camera: Camera, floor: Floats, fine: int = 1
    ) -> Floats:
        """Return the factor (fine height, fine width, 3) of marks and colours of a frame.

        It applies to frames that are rendered directly.
        """
        window = self._window(points, camera).times(fine)
        parts = scaled(camera, fine)
        # The direct rendering has the cloth's own colours. The factor is 1 as far as cloth covers a
        # pixel.
        cover = np.zeros((parts.height, parts.width), dtype=np.float32)
        geometry = self._geometry
        cover[window.slices] = coverage_of_window(
            projected(parts, points),
            geometry.triangles,
            window,
            GRID // fine,
            geometry.cloth_triangles,
        )
        marks = (
            (self._tinted(floor, points, camera) - 1.0).repeat(fine, axis=0).repeat(fine, axis=1)
        )
        return np.asarray(1.0 + (1.0 - cover[..., None]) * marks, dtype=np.float32)

    def _tinted(self, floor: Floats, points: npt.NDArray[np.float64], camera: Camera) -> Floats:
        """Return the factor (height, width, 3) of everything except the cloth.

        A pixel has the factor of the floor, or of the prop in front of it.
        """
        geometry = self._geometry
        if not geometry.surroundings.props:
            return floor
        projections = projected(camera, points)
        window = window_about(projections[geometry.cloth_vertices :], camera)
        if not window.area:
            return floor

        # The colour of bodies and holders is the mean over the samples of a pixel.
        props = np.ascontiguousarray(geometry.triangles[geometry.cloth_triangles :])
        visible = see(projections, props, window, _PROP_GRID)
        samples = [
            visible.triangle[row::_PROP_GRID, column::_PROP_GRID]
            for row, column in product(range(_PROP_GRID), repeat=2)
        ]
        tint = sum(
            (geometry.tints[sample] for sample in samples), np.zeros(1, dtype=np.float32)
        ) / len(samples)

        # Further sheets have pictures. `see_albedo` reads the first triangles of a mesh, so roll
        # each sheet to the front.
        for sheet in geometry.printed:
            count = sheet.triangles.stop - sheet.triangles.start
            first = sheet.triangles.start
            turned = np.where(
                visible.triangle < 0, -1, (visible.triangle - first) % len(props)
            ).astype(np.int32)
            rolled = replace(visible, triangles=np.roll(props, -first, axis=0), triangle=turned)
            sight = see_albedo(rolled, geometry.uv, sheet.textures, count)
            tint = tint + sight.coverage[..., None] * sight.mean[:, :, 0] / np.float32(sheet.grey)

        # A prop hides the floor, as far as it covers a pixel.
        factor = floor.copy()
        factor[window.slices] = (
            tint + (1.0 - visible.share_below(len(props))[..., None]) * factor[window.slices]
        )
        return factor

    def _albedo(
        self, points: npt.NDArray[np.float64], window: Window, grid: int, textures: Textures
    ) -> Albedo:
        """Return the cloth in a window, from projected vertices (V, 3)."""
        geometry = self._geometry
        return albedo_of_window(
            points,
            geometry.triangles,
            window,
            grid,
            uv=geometry.uv,
            textures=textures,
            cloth=geometry.cloth_triangles,
        )

    def _window(self, points: npt.NDArray[np.float64], camera: Camera) -> Window:
        return window_about(projected(camera, points[: self._geometry.cloth_vertices]), camera)

    def _mirror(
        self,
        overall: Floats,
        points: npt.NDArray[np.float64],
        camera: Camera,
        substrate: Substrate,
        textures: Textures,
        enlargement: float,
    ) -> tuple[Floats, Window]:
        """Return the albedo of the cloth that the floor mirrors, (height, width, 3 textures)."""
        floor = self._geometry.surroundings.floor
        assert floor is not None
        below = projected(camera, mirrored(points, floor))
        margin = round(_MIRROR_MARGIN * enlargement)
        window = window_about(below[: self._geometry.cloth_vertices], camera, margin)
        nothing = np.empty((0, 0, 3 * textures.count), dtype=np.float32), Window(0, 0, 0, 0)
        if not window.area:
            return nothing

        # Make the mirror image of the cloth, as if the floor were a window.
        sight = self._albedo(below, window, _MIRROR_GRID, textures)
        if not sight.coverage.any():
            return nothing

        # The distance of the image behind the floor decides how far a rough floor blurs it. The
        # edge of the cloth has no depth, so take the mean around it.
        beyond = _beyond_floor(see(below, self._geometry.triangles, window, 1), camera, floor)
        coverage_of_image = sight.coverage[..., None]
        wide = np.full(beyond.shape, _PATH_BLUR * enlargement, dtype=np.float32)
        around = _raster.blurred(
            np.concatenate([coverage_of_image, coverage_of_image * beyond[..., None]], axis=2),
            wide,
            wide,
        )
        path = np.clip(around[..., 1] / np.maximum(around[..., 0], np.float32(1e-6)), 0.0, 1.0)

        # Look from the point at which the mirrored ray meets the floor. A lobe of microfacets of
        # width roughness^2 is narrower across the plane of incidence than in it. The ratio is the
        # sine of the angle at which the camera looks down.
        down = np.asarray(
            path * np.float32(_LOBE * camera.fy * substrate.roughness**2), dtype=np.float32
        )
        across = np.asarray(down * np.float32(-np.asarray(camera.rotation)[2, 2]), dtype=np.float32)

        # Blur coverage and colour alike. Their ratio is the colour. In places with hardly any
        # mirrored cloth, the mean colour takes its part.
        flat = (coverage_of_image[..., None] * sight.mean).reshape(*beyond.shape, -1)
        blurred = _raster.blurred(np.concatenate([coverage_of_image, flat], axis=2), down, across)
        coverage = blurred[..., :1]
        confidence = np.minimum(coverage / _SURE_COVERAGE, 1.0)
        color = blurred[..., 1:] / np.maximum(coverage, 1e-6)
        mean = overall.ravel()
        return (mean + confidence * (color - mean)).astype(np.float32), window


def _beyond_floor(visible: VisibleTriangles, camera: Camera, height: float) -> Floats:
    """Return the distance of a mirrored thing behind the floor, over its depth.

    The shape is (height, width). A pixel without a mirror image has 0.
    """
    depth = visible.at_centers(visible.points[:, 2:])[..., 0]
    window = visible.window
    rows, columns = np.mgrid[window.top : window.bottom, window.left : window.right]
    ray = np.stack(
        [(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones(rows.shape)],
        axis=-1,
    )
    # A ray that does not go down meets the floor only very far away.
    down = (ray @ np.asarray(camera.rotation))[..., 2]
    floor = (height - camera.position[2]) / np.where(down < -1e-6, down, -1e-6)
    fraction = np.where(depth > 0.0, 1.0 - floor / np.maximum(depth, 1e-6), 0.0)
    return np.clip(fraction, 0.0, 1.0).astype(np.float32)
