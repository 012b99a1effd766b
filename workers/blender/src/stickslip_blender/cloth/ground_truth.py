"""Ground truth of every pixel: depth, segmentation, normals, texture coordinates, optical flow.

Every value describes the first thing that the ray through the middle of a pixel meets: the cloth, a
prop, or the floor.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cloth.geometry import BACKGROUND, Geometry
from stickslip_blender.cycles.pixels import encode
from stickslip_blender.raster import Window, _raster, decoded, projected, see

NOTHING = {"depth": np.inf, "segmentation": BACKGROUND, "normals": 0.0, "uv": np.nan, "flow": 0.0}
"""Values of pixels that show nothing, by name of the ground truth."""


def on_canvas(
    frames: npt.NDArray[Any], canvas: tuple[int, int] | None, nothing: float = 0
) -> npt.NDArray[Any]:
    """Return frames (n, height, width, ...) in the upper left of a canvas (width, height) [px].

    The rest of the canvas shows `nothing`. Without a canvas, frames stay as they are.
    """
    if canvas is None:
        return frames
    width, height = canvas
    widened = np.full((len(frames), height, width, *frames.shape[3:]), nothing, frames.dtype)
    widened[:, : frames.shape[1], : frames.shape[2]] = frames
    return widened


def apply_lens_distortion(video: npt.NDArray[np.uint8], camera: Camera) -> npt.NDArray[np.uint8]:
    """Return a video (frames, height, width, 3) as its camera shows it, 8-bit sRGB.

    The input shows the view of the camera's `pinhole`. The function interpolates each pixel between
    four pixels, in linear light.
    """
    if not any(camera.distortion):
        return video
    _, _, places = traced(camera)
    # Find the upper left of the four pixels in the pinhole's frame, and the position between them.
    corner = np.floor(places).astype(int)
    fraction = (places - corner)[..., None].astype(np.float32)
    column = corner[..., 0]
    row = corner[..., 1]
    across = fraction[:, :, 0]
    down = fraction[:, :, 1]
    result = np.empty((len(video), *column.shape, 3), dtype=np.uint8)
    for frame, picture in enumerate(video):
        upper_left = decoded(picture[row, column])
        upper_right = decoded(picture[row, column + 1])
        lower_left = decoded(picture[row + 1, column])
        lower_right = decoded(picture[row + 1, column + 1])
        upper = upper_left + across * (upper_right - upper_left)
        lower = lower_left + across * (lower_right - lower_left)
        result[frame] = encode(upper + down * (lower - upper))
    return result


@lru_cache(maxsize=4)  # every frame and every texture calls it
def traced(camera: Camera) -> tuple[Camera, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return a camera's pinhole, its rays (height, width, 3), and their pixels.

    The pixels are positions in the pinhole's frame [px].
    """
    pinhole = camera.pinhole()
    rays = camera.rays()
    return pinhole, rays, rays[..., :2] * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)


def ground_truth(
    geometry: Geometry,
    points: npt.NDArray[np.float64],
    following: npt.NDArray[np.float64],
    camera: Camera,
) -> dict[str, npt.NDArray[Any]]:
    """Return the ground truth of an instant by name.

    It needs all vertices (V, 3) [m] at the instant and at the next frame.

    - `depth` (height, width): along the optical axis [m], infinite for the background
    - `segmentation` (height, width): codes
    - `normals` (height, width, 3): of length 1, towards the camera, in its axes (right, down,
      forward); 0 for the background
    - `uv` (height, width, 2): texture coordinates of the cloth, NaN elsewhere
    - `flow` (height, width, 2): motion of the visible points until the next frame [px], columns and
      rows
    """
    pinhole, rays, places = traced(camera)
    # Find the nearest triangle at the middle of each pixel. A lens moves the pixels.
    here = projected(pinhole, points)
    visible = see(here, geometry.triangles, Window(0, 0, pinhole.width, pinhole.height), grid=1)
    if pinhole is not camera:
        visible = visible.looked_up(places)
    values = visible.at_centers(np.concatenate([here[:, 2:], geometry.uv, following], axis=1))

    # Normals are smooth only within a skin. A sharp edge has a vertex for each of its sides.
    skins = replace(visible, points=here[geometry.shaded], triangles=geometry.shaded_triangles)
    smooth = skins.at_centers(_raster.normals(points[geometry.shaded], geometry.shaded_triangles))
    thing = visible.triangle >= 0
    cloth = thing & geometry.has_uv[visible.triangle]

    # The floor has no triangles. It is visible in pixels without any other object.
    floor = _floor_depth(camera, rays, geometry.surroundings.floor)
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    moved, _ = camera.project(values[..., 3:6])
    segmentation = np.where(np.isfinite(floor), geometry.surroundings.ground, BACKGROUND)
    segmentation[thing] = geometry.segments[visible.triangle[thing]]

    # Turn the normals into the axes of the camera and towards it, because cloth has two sides.
    normal = np.where(thing[..., None], smooth, (0.0, 0.0, 1.0)) @ np.asarray(camera.rotation).T
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.maximum(length, 1e-12)
    normal = np.where((normal * rays).sum(axis=-1, keepdims=True) > 0.0, -normal, normal)
    normal[segmentation == BACKGROUND] = 0.0
    return {
        "depth": np.where(thing, values[..., 0], floor).astype(np.float32),
        "segmentation": segmentation.astype(np.uint8),
        "normals": normal.astype(np.float16),
        "uv": np.where(cloth[..., None], values[..., 1:3], np.nan).astype(np.float16),
        "flow": np.where(thing[..., None], moved - pixels, 0.0).astype(np.float16),
    }


def _floor_depth(
    camera: Camera, rays: npt.NDArray[np.float64], height: float | None
) -> npt.NDArray[np.float64]:
    """Return the depth at which rays (height, width, 3) meet the floor."""
    down = (rays @ np.asarray(camera.rotation))[..., 2]
    with np.errstate(divide="ignore"):
        depth = ((np.inf if height is None else height) - camera.position[2]) / down
    return np.where((down < 0.0) & (height is not None), depth, np.inf)
