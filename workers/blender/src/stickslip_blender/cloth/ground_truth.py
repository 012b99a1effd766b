"""Ground truth of every pixel: depth, segmentation, normals, texture coordinates, optical flow.

All of it is what the ray through the middle of a pixel meets first: the cloth, a prop, or the floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.cloth.geometry import FLOOR, Geometry
from stickslip_blender.raster import Window, _raster, projected, see

BACKGROUND, GROUND, CLOTH, PROP = range(4)
"""Codes of the segmentation, in the order of `stickslip_schemas.kinds.cloth.arrays.SEGMENTS`."""

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
    here = projected(camera, points)
    seen = see(here, geometry.triangles, Window(0, 0, camera.width, camera.height), grid=1)
    moved = projected(camera, following)
    normals = _raster.normals(points, geometry.triangles) @ np.asarray(camera.rotation).T
    values = seen.at_centers(np.concatenate([here[:, 2:], geometry.uv, (moved - here)[:, :2], normals], axis=1))
    thing = seen.triangle >= 0
    cloth = thing & (seen.triangle < geometry.cloth_triangles)

    rays, floor = _floor_depth(camera)
    depth = np.where(thing, values[..., 0], floor)
    segmentation = np.select([cloth, thing, np.isfinite(floor)], [CLOTH, PROP, GROUND], BACKGROUND).astype(np.uint8)
    normal = np.where(thing[..., None], values[..., 5:8], np.asarray(camera.rotation)[:, 2])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / np.maximum(length, 1e-12)
    normal = np.where((normal * rays).sum(axis=-1, keepdims=True) > 0.0, -normal, normal)
    normal[segmentation == BACKGROUND] = 0.0
    return GroundTruth(
        depth=depth.astype(np.float32),
        segmentation=segmentation,
        normals=normal.astype(np.float16),
        uv=np.where(cloth[..., None], values[..., 1:3], np.nan).astype(np.float16),
        flow=np.where(thing[..., None], values[..., 3:5], 0.0).astype(np.float16),
    )


def _floor_depth(camera: Camera) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the rays (height, width, 3), of depth 1, in camera axes, and the depth at which they meet the floor."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    down = (rays @ np.asarray(camera.rotation))[..., 2]
    with np.errstate(divide="ignore"):
        depth = (FLOOR - camera.position[2]) / down
    return rays, np.where(down < 0.0, depth, np.inf)
