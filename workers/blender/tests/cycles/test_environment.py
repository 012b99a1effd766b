"""The panorama lights from where it says."""

import numpy as np
import pytest
from stickslip_blender.cycles.engine import Sampling, import_bpy, new_scene, set_sampling
from stickslip_blender.cycles.objects import SoftBox, add_view, panorama, set_environment, set_view
from stickslip_blender.cycles.pixels import FrameReader
from stickslip_testing.cameras import looking_at


@pytest.mark.parametrize(
    ("azimuth", "elevation", "bright"),
    [
        (0.0, 0.0, "right"),
        (180.0, 0.0, "left"),
        (90.0, 90.0, "top"),
        (0.0, -90.0, "bottom"),
        (270.0, 0.0, "middle"),
    ],
)
def test_a_ball_is_lit_from_where_the_soft_box_stands(
    azimuth: float, elevation: float, bright: str
) -> None:
    scene = new_scene()
    set_sampling(scene, Sampling(samples=32))
    set_environment(
        scene, panorama([SoftBox(azimuth, elevation, radiance=1.0, sharpness=8.0)], 0.0), ground=0.0
    )
    import_bpy().ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=1.0)
    add_view(scene)
    set_view(  # from -y, so that +x is on the right
        scene,
        looking_at(
            (0.0, 0.0, 0.0),
            azimuth=270.0,
            elevation=0.0,
            distance=10.0,
            name="a",
            width=33,
            height=33,
            focal=130.0,
        ),
    )
    reader = FrameReader(scene)
    frame = reader.read_light().astype(float).mean(axis=2)
    spots = {
        "left": frame[16, 6],
        "right": frame[16, 26],
        "top": frame[6, 16],
        "bottom": frame[26, 16],
        "middle": frame[16, 16],
    }
    assert max(spots, key=lambda name: spots[name]) == bright, spots
    assert frame[0, 0] == 0.0


def test_the_panorama_is_as_bright_as_it_says() -> None:
    light = panorama([SoftBox(30.0, 20.0, radiance=2.0, sharpness=4.0)], 0.25)
    assert light.dtype == np.float32
    assert light.min() == pytest.approx(0.25)
    assert light.max() == pytest.approx(2.25, abs=0.01)
