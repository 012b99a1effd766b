"""Props: a floor whose marks are not on them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from stickslip_blender.cloth.geometry import CLOTH, GROUND, PROP, Geometry, Holders
from stickslip_blender.cloth.ground_truth import ground_truth
from stickslip_blender.cloth.shading import Composer
from stickslip_schemas.spec.cameras import load_rig


def test_marks_of_the_floor_are_not_on_props(make_sheet: Callable[..., Any]) -> None:
    sheet = make_sheet(17)
    geometry = Geometry(sheet.triangles, sheet.rest, Holders(sheet.rest))
    camera = load_rig("drag")[0]
    points = geometry.points(sheet.track[1], 1)
    codes = ground_truth(geometry, points, points, camera)["segmentation"]
    floor = np.full((camera.height, camera.width, 3), 2.0, dtype=np.float32)
    marked = Composer(geometry).floor_factor(points, camera, floor)
    inner = {code: marked[_inside(codes == code)] for code in (GROUND, CLOTH, PROP)}
    assert all(len(values) > 20 for values in inner.values())
    assert np.allclose(inner[GROUND], 2.0)
    assert np.allclose(inner[CLOTH], 1.0)
    assert np.allclose(inner[PROP], 1.0)
    finer = Composer(geometry).floor_factor(points, camera, floor, 2)
    boxes = finer.reshape(camera.height, 2, camera.width, 2, 3).mean(axis=(1, 3))
    edge = np.abs(marked - 1.5) < 0.4
    assert edge.sum() > 100
    np.testing.assert_allclose(boxes, marked, atol=0.05)
    assert ((finer == 1.0) | (finer == 2.0)).sum() > 4 * (
        (marked == 1.0) | (marked == 2.0)
    ).sum()  # less is mixed


def _inside(mask: Any) -> Any:
    """Return where a mask holds at a pixel and at all eight around it."""
    padded = np.pad(mask, 1)
    rows, columns = mask.shape
    around = [padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3)]
    return np.logical_and.reduce(around)
