"""What is composed is what the formula says, and what Cycles renders directly."""

from typing import Any

import numpy as np
import pytest
from stickslip_blender.cloth.clips import GATE, ClothRenderer, block_decibels
from stickslip_blender.cloth.geometry import Holders
from stickslip_blender.cycles.engine import ClothSampling
from stickslip_blender.cycles.pixels import encode
from stickslip_schemas.kinds.cloth_drag import ClothDragRender
from stickslip_schemas.spec.cameras import load_rig, rig_digest


def test_encoding_is_srgb() -> None:
    light = np.array([-0.1, 0.0, 0.001, 0.0031308, 0.2, 0.5, 1.0, 3.0], dtype=np.float32)
    assert encode(light).tolist() == [0, 0, 3, 10, 124, 188, 255, 255]


def test_the_gate_sees_bias_through_noise() -> None:
    random = np.random.Generator(np.random.PCG64(1))
    picture = np.full((40, 40, 3), 120, dtype=np.uint8)
    noisy = np.clip(picture + random.normal(0.0, 8.0, picture.shape), 0, 255).astype(np.uint8)
    assert block_decibels(noisy, picture) > GATE + 5.0
    assert block_decibels(picture + np.uint8(9), picture) < GATE


@pytest.mark.parametrize("substrate", ["matt", "polyester-mirror"])
def test_a_composed_picture_is_the_direct_one(sheet: Any, substrate: str) -> None:
    look = ClothDragRender(
        rig="drag",
        rig_digest=rig_digest("drag"),
        quality="draft",
        material="gray-interlock",
        texture="plaid",
        viewpoint="calibrated",
        instants=(1,),
        light_seed=3,
        crease_seed=5,
        creases=0.5,
        substrate=substrate,
    )
    renderer = ClothRenderer(sheet.triangles, sheet.rest, Holders)
    clip = renderer.clip(look, load_rig("drag")[0], sheet.track[1:2], sampling=ClothSampling(frame=4, window=16))
    shading = clip.shading()
    renderer.close()
    assert shading.gate_db > 36.0
    assert shading.composed
