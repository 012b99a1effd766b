"""Blender's camera projects as the calibrated one."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from stickslip_blender.cycles.engine import Sampling, import_bpy, new_scene, set_sampling
from stickslip_blender.cycles.objects import add_view, set_view
from stickslip_blender.cycles.pixels import FrameReader
from stickslip_schemas.spec.cameras import Camera, load_rig
from stickslip_testing.cameras import looking_at

_SKEWED = Camera.model_validate(  # rolled, off-centre, not square, pixels not square either
    looking_at(
        (0.0, 0.0, -0.5),
        azimuth=25.0,
        elevation=30.0,
        distance=3.0,
        name="skewed",
        width=200,
        height=120,
        focal=300.0,
    ).model_dump()
    | {"fx": 310.0, "fy": 260.0, "cx": 83.0, "cy": 71.5}
)
_ROLL = np.array(
    [[np.cos(0.3), -np.sin(0.3), 0.0], [np.sin(0.3), np.cos(0.3), 0.0], [0.0, 0.0, 1.0]]
)
ROLLED = Camera.model_validate(
    _SKEWED.model_dump()
    | {
        "name": "rolled",
        "rotation": (_ROLL @ _SKEWED.rotation).tolist(),
        "translation": (_ROLL @ _SKEWED.translation).tolist(),
    }
)
TALL = Camera.model_validate(
    _SKEWED.model_dump()
    | {"name": "tall", "width": 90, "height": 210, "fy": 400.0, "cx": 50.0, "cy": 101.0}
)
CAMERAS = (*load_rig("rod-4"), _SKEWED, ROLLED, TALL)
POINTS = ((0.0, 0.0, -0.5), (0.1, -0.05, -0.65), (-0.12, 0.08, -0.35))


def _add_lamp(scene: Any) -> Any:
    """A small ball that shines by itself, half as bright as white."""
    bpy = import_bpy()
    material = bpy.data.materials.new("lamp")
    material.node_tree.nodes.clear()
    emission = material.node_tree.nodes.new("ShaderNodeEmission")
    emission.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1.0)
    output = material.node_tree.nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(emission.outputs["Emission"], output.inputs["Surface"])
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=0.03)
    lamp = bpy.context.object
    lamp.data.materials.append(material)
    return lamp


def _centroid(frame: npt.NDArray[np.uint8]) -> npt.NDArray[np.float64]:
    encoded = frame[..., 0] / 255.0
    light = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    rows, columns = np.indices(light.shape)
    return np.array([(columns * light).sum(), (rows * light).sum()]) / light.sum()


def test_a_ball_is_seen_where_the_camera_projects_it() -> None:
    scene = new_scene()
    scene.world.node_tree.nodes["Background"].inputs["Strength"].default_value = 0.0
    set_sampling(scene, Sampling(samples=16))
    add_view(scene)
    lamp = _add_lamp(scene)
    reader = FrameReader(scene)
    for camera in CAMERAS:
        set_view(scene, camera)
        for point in POINTS:
            lamp.location = point
            frame = np.minimum(reader.read_light().astype(float), 1.0)
            assert frame.shape == (camera.height, camera.width, 3)
            error = _centroid(frame) - camera.project(point)[0]
            assert np.abs(error).max() < 0.1, (camera.name, point, error)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
def test_blender_agrees_about_projection(camera: Camera) -> None:
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    scene = new_scene()
    view = add_view(scene)
    set_view(scene, camera)
    import_bpy().context.view_layer.update()
    for point in POINTS:
        x, y, depth = world_to_camera_view(scene, view, Vector(point))
        pixel, own_depth = camera.project(point)
        by_blender = (x * camera.width - 0.5, (1.0 - y) * camera.height - 0.5)
        np.testing.assert_allclose(by_blender, pixel, atol=2e-3)
        assert depth == pytest.approx(float(own_depth), abs=1e-5)
