"""Ground truth against projection: every claim about a pixel is checked with the camera's own
formula.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from stickslip_blender.cloth.geometry import (
    BACKGROUND,
    CLOTH,
    FLOOR,
    GROUND,
    PROP,
    Geometry,
    Holders,
)
from stickslip_blender.cloth.ground_truth import ground_truth
from stickslip_schemas.kinds.cloth.spec import SEGMENTS, GroundTruth
from stickslip_schemas.spec.cameras import Lens, load_rig


def test_the_contract_and_the_renderer_name_the_same_things() -> None:
    codes = (BACKGROUND, GROUND, CLOTH, PROP)
    assert dict(zip(SEGMENTS, codes, strict=True)) == {
        "background": 0,
        "floor": 1,
        "cloth": 2,
        "prop": 3,
    }


@pytest.mark.parametrize(
    "lens", [(0.0,) * 5, (-0.28, 0.09, 0.0012, -0.0008, 0.0), (0.3, 0.0, 0.0, 0.0, 0.0)]
)
def test_ground_truth_is_what_projection_says(make_sheet: Callable[..., Any], lens: Lens) -> None:
    sheet = make_sheet(17)
    geometry = Geometry(sheet.triangles, sheet.rest, Holders(sheet.rest))
    camera = load_rig("drag")[0].model_copy(update={"distortion": lens})
    now, then = (geometry.points(sheet.track[k], k) for k in (1, 2))
    truth = ground_truth(geometry, now, then, camera)

    assert set(truth) == set(GroundTruth)
    assert set(np.unique(truth["segmentation"])) == {GROUND, CLOTH, PROP}
    v, u = np.mgrid[:224, :224]
    ray = camera.rays()
    place = (truth["depth"][..., None] * ray - camera.translation) @ np.asarray(camera.rotation)
    floor = truth["segmentation"] == GROUND
    np.testing.assert_allclose(place[floor][:, 2], FLOOR, atol=1e-6)
    assert not truth["flow"][floor].any()
    up = np.asarray(camera.rotation) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(
        truth["normals"][floor], np.broadcast_to(up, truth["normals"][floor].shape), atol=5e-4
    )

    cloth = truth["segmentation"] == CLOTH
    assert cloth.sum() > 2000
    assert np.isfinite(truth["uv"][cloth]).all()
    assert np.isnan(truth["uv"][~cloth]).all()
    vertices = now[: geometry.cloth_vertices]
    for point, uv in zip(place[cloth][::40], truth["uv"][cloth][::40], strict=True):
        distance = np.linalg.norm(vertices - point, axis=1)
        assert distance.min() < 0.005
        assert np.abs(uv - geometry.uv[distance.argmin()]).max() < 0.05
    # The sheet is dragged along x without changing its shape.
    shift = then[0] - now[0]
    moved, _ = camera.project(place[cloth] + shift)
    np.testing.assert_allclose(
        truth["flow"][cloth], moved - np.column_stack([u[cloth], v[cloth]]), atol=0.02
    )
    facing = (truth["normals"][cloth] * ray[cloth]).sum(axis=1)
    assert (facing <= 1e-3).all()
    np.testing.assert_allclose(
        np.linalg.norm(truth["normals"][cloth].astype(np.float64), axis=1), 1.0, atol=2e-3
    )
