"""Ground truth of every pixel: depth, segmentation, normals, texture coordinates, optical flow.

All of it is what the ray through the middle of a pixel meets first: the cloth, a prop, or the floor.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cloth.geometry import BACKGROUND, Geometry
from stickslip_blender.cloth.lens import traced
from stickslip_blender.raster import Window, _raster, projected, see

Floats = npt.NDArray[np.float32]
Halves = npt.NDArray[np.float16]


@dataclass(frozen=True)
class GroundTruth:
    """The ground truth of one frame."""

    depth: Floats
    """Along the optical axis [m], infinite where there is nothing; shape (height, width)."""
    segmentation: npt.NDArray[np.uint8]
    """Codes, shape (height, width)."""
    normals: Halves
    """Of length 1, towards the camera, in its axes (x right, y down, z forward); 0 where there is nothing; shape
    (height, width, 3)."""
    uv: Halves
    """Texture coordinates of the cloth, NaN elsewhere; shape (height, width, 2)."""
    flow: Halves
    """Motion of the visible points until the next frame [px], columns and rows; shape (height, width, 2)."""


def ground_truth(
    geometry: Geometry, points: npt.NDArray[np.float64], following: npt.NDArray[np.float64], camera: Camera
) -> GroundTruth:
    """Return the ground truth of an instant: all vertices (V, 3) [m] then, and at the next frame."""
    pinhole, rays, places = traced(camera)
    here = projected(pinhole, points)
    seen = see(here, geometry.triangles, Window(0, 0, pinhole.width, pinhole.height), grid=1)
    if pinhole is not camera:
        seen = seen.looked_up(places)
    values = seen.at_centers(np.concatenate([here[:, 2:], geometry.uv, following], axis=1))
    skins = replace(seen, points=here[geometry.shaded], triangles=geometry.shaded_triangles)
    smooth = skins.at_centers(_raster.normals(points[geometry.shaded], geometry.shaded_triangles))
    thing = seen.triangle >= 0
    cloth = thing & geometry.has_uv[seen.triangle]

    floor = _floor_depth(camera, rays, geometry.surroundings.floor)
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    moved, _ = camera.project(values[..., 3:6])
    segmentation = np.where(np.isfinite(floor), geometry.surroundings.ground, BACKGROUND)
    segmentation[thing] = geometry.segments[seen.triangle[thing]]
    normal = np.where(thing[..., None], smooth, (0.0, 0.0, 1.0)) @ np.asarray(camera.rotation).T
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.maximum(length, 1e-12)
    normal = np.where((normal * rays).sum(axis=-1, keepdims=True) > 0.0, -normal, normal)
    normal[segmentation == BACKGROUND] = 0.0
    return GroundTruth(
        depth=np.where(thing, values[..., 0], floor).astype(np.float32),
        segmentation=segmentation.astype(np.uint8),
        normals=normal.astype(np.float16),
        uv=np.where(cloth[..., None], values[..., 1:3], np.nan).astype(np.float16),
        flow=np.where(thing[..., None], moved - pixels, 0.0).astype(np.float16),
    )


def _floor_depth(camera: Camera, rays: npt.NDArray[np.float64], height: float | None) -> npt.NDArray[np.float64]:
    """Return the depth at which rays (height, width, 3) meet the floor."""
    down = (rays @ np.asarray(camera.rotation))[..., 2]
    with np.errstate(divide="ignore"):
        depth = ((np.inf if height is None else height) - camera.position[2]) / down
    return np.where((down < 0.0) & (height is not None), depth, np.inf)
