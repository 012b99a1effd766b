"""Set Blender's camera up from a calibrated one."""

from __future__ import annotations

from typing import Any

import numpy as np
from stickslip_schemas.spec.cameras import Camera

from stickslip_blender.blender import import_bpy

SENSOR_WIDTH = 36.0  # [mm]; only the ratio of focal length to sensor width shows in the image
_CLIP = (1e-3, 1e3)  # [scene units]


def new_view(scene: Any) -> Any:
    """Add a camera object, make it the scene's, and return it."""
    bpy = import_bpy()
    data = bpy.data.cameras.new("view")
    data.type = "PERSP"
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR_WIDTH
    data.clip_start, data.clip_end = _CLIP
    view = bpy.data.objects.new("view", data)
    scene.collection.objects.link(view)
    scene.camera = view
    return view


def set_view(scene: Any, camera: Camera) -> None:
    """Make the scene's camera project as `camera` does.

    Blender's camera looks along -z with y up, and its shifts are in units of the image's width, in square pixels.
    """
    from mathutils import Matrix

    render, view = scene.render, scene.camera
    render.resolution_x, render.resolution_y = camera.width, camera.height
    # Pixels that are not square: Blender wants both aspects >= 1 and measures in the narrower of the two.
    ratio = camera.fx / camera.fy  # a pixel's height over its width
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, 1.0 / ratio), max(1.0, ratio)
    view.data.lens = camera.fx / camera.width * SENSOR_WIDTH
    view.data.shift_x = ((camera.width - 1) / 2 - camera.cx) / camera.width
    view.data.shift_y = (camera.cy - (camera.height - 1) / 2) / camera.width * ratio
    pose = np.eye(4)
    pose[:3, :3] = np.asarray(camera.rotation).T @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = camera.position
    view.matrix_world = Matrix(pose.tolist())
