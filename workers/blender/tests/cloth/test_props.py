"""Props: a figure that follows its bones, a ball that follows its poses, and a floor whose marks are not on them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from stickslip_blender.cloth.geometry import CLOTH, GROUND, PROP, Geometry, Holders
from stickslip_blender.cloth.ground_truth import ground_truth
from stickslip_blender.cloth.shading import Composer
from stickslip_blender.scenes.cloth_sphere import Ball
from stickslip_blender.scenes.shawl import SUNK, Figure
from stickslip_schemas.spec.cameras import load_rig


def ball() -> tuple[Any, Any]:
    """Return the vertices (14, 3) and triangles (24, 3) of a cube of side 2 whose faces are cut into four."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    middles = [np.mean([corners[k] for k in side], axis=0) for side in sides]
    triangles = [(8 + n, side[k], side[(k + 1) % 4]) for n, side in enumerate(sides) for k in range(4)]
    return np.array([*corners, *middles], dtype=float), np.array(triangles, dtype=np.int32)


def test_a_figure_follows_its_bones() -> None:
    skin, triangles = ball()
    upper = (skin[:, 2] > 0).astype(float)
    bones = np.zeros((2, 2, 3, 4))
    bones[:, :, :, :3] = np.eye(3)
    bones[1, 1, :, 3] = (0.0, 0.5, 1.0)
    weights = np.stack([1.0 - upper, upper], axis=1)
    figure = Figure(skin[:, :2], skin=skin, triangles=triangles, weights=weights, bones=bones)
    (rest,), (moved,) = figure.placed(0, skin), figure.placed(1, skin)
    shift = np.linalg.norm(rest - skin, axis=1)
    assert np.allclose(shift, SUNK)  # inside, by half a thickness
    assert (np.linalg.norm(rest, axis=1) < np.linalg.norm(skin, axis=1)).all()
    assert np.allclose(moved - rest, upper[:, None] * [0.0, 0.5, 1.0])
    assert figure.props[0].is_smooth


def test_a_ball_stands_on_the_floor_and_turns_with_its_poses() -> None:
    poses = np.zeros((2, 3, 4))
    poses[0, :, :3], poses[1, :, :3] = np.eye(3), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    poses[:, 2, 3] = 0.05
    made = Ball(np.zeros((4, 2)), poses=poses)
    still, turned = (np.concatenate(made.placed(instant, np.zeros((4, 3)))) for instant in (0, 1))
    assert np.allclose(made.aim(1, still), [0.0, 0.0, 0.05])
    assert np.allclose(np.linalg.norm(still - [0.0, 0.0, 0.05], axis=1), 0.05 - SUNK)
    assert np.allclose(turned, np.column_stack([-still[:, 1], still[:, 0], still[:, 2]]))


def test_marks_of_the_floor_are_not_on_props(make_sheet: Callable[..., Any]) -> None:
    sheet = make_sheet(17)
    geometry = Geometry(sheet.triangles, sheet.rest, Holders(sheet.rest))
    camera = load_rig("drag")[0]
    points = geometry.points(sheet.track[1], 1)
    seen = ground_truth(geometry, points, points, camera).segmentation
    light = np.ones((camera.height, camera.width, 3), dtype=np.float16)
    marked = Composer(geometry).on_floor(light, points, camera, np.full(light.shape, 2.0, dtype=np.float32))
    inner = {code: marked[_inside(seen == code)] for code in (GROUND, CLOTH, PROP)}
    assert all(len(values) > 20 for values in inner.values())
    assert np.allclose(inner[GROUND], 2.0)
    assert np.allclose(inner[CLOTH], 1.0)
    assert np.allclose(inner[PROP], 1.0)


def _inside(mask: Any) -> Any:
    """Return where a mask holds at a pixel and at all eight around it."""
    padded = np.pad(mask, 1)
    rows, columns = mask.shape
    around = [padded[r : r + rows, c : c + columns] for r in range(3) for c in range(3)]
    return np.logical_and.reduce(around)
