"""Floors and lamps keep within their ranges, and a seed says which."""

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from stickslip_blender.cloth.geometry import FLOOR
from stickslip_blender.cloth.looks import (
    FINISHES,
    HARD,
    LOOKS,
    SOURCES,
    drawn_light,
    drawn_substrate,
    fabric_appearance,
    floor_factor,
    print_on_fabric,
)
from stickslip_blender.cloth.surface import Surface
from stickslip_blender.raster import decoded
from stickslip_schemas.spec.cameras import load_rig
from stickslip_schemas.spec.names import Lighting, Material, Substrate


def test_the_contract_and_the_renderer_name_the_same_things() -> None:
    assert tuple(Lighting) == tuple(SOURCES)
    assert tuple(Substrate) == (*FINISHES, "any")
    assert set(Material) == set(LOOKS)


@pytest.mark.parametrize("name", Substrate)
def test_a_substrate_is_drawn_by_its_seed(name: str) -> None:
    drawn = [drawn_substrate(name, seed) for seed in range(60)]
    assert drawn[7] == drawn_substrate(name, 7)
    assert len({substrate.numbers[1] for substrate in drawn}) == 60
    names = {substrate.name for substrate in drawn}
    assert names == ({"matt", *HARD} if name == "any" else {name})
    assert all(0.0 < substrate.albedo < 1.0 for substrate in drawn)
    assert all(np.mean(substrate.tint) == pytest.approx(1.0) for substrate in drawn)
    assert (len({substrate.tint for substrate in drawn}) > 1) == (name == "cloth")


def test_held_out_lamps_are_not_among_those_to_train_with() -> None:
    usual, other = (
        [drawn_light(name, seed).numbers for seed in range(200)] for name in ("drawn", "held-out")
    )
    low, high = np.min(usual, axis=0), np.max(usual, axis=0)
    assert not ((low <= other) & (other <= high)).any()
    studio, room, window = (drawn_light(name, 1).source for name in ("drawn", "room", "window"))
    assert studio.surround < window.surround < room.surround
    assert studio.diameter < window.diameter < room.diameter


def test_marks_lie_still_on_the_floor() -> None:
    """Two cameras see the same mark at the same place of the floor."""
    substrate = drawn_substrate("matt", 3)
    left, other = load_rig("drag")[:2]
    place = np.array(
        [[x, y, FLOOR] for x in np.linspace(0.0, 0.3, 12) for y in np.linspace(-0.1, 0.1, 9)]
    )
    centers = []
    for camera in (left, other):
        factor = floor_factor(substrate, camera, FLOOR)
        column, row = np.rint(camera.project(place)[0]).astype(int).T
        centers.append(factor[row, column, 0])
    assert np.std(centers[0]) > 0.1
    assert np.corrcoef(centers)[0, 1] > 0.7  # a pixel apart at most


def test_fabrics_differ_in_their_grain(sheet: Any) -> None:
    surface = Surface(sheet.triangles, sheet.rest)
    white = np.full((256, 256, 3), 200, dtype=np.uint8)
    prints = {
        material: print_on_fabric(white, fabric_appearance(material), surface) for material in LOOKS
    }
    assert len({picture.tobytes() for picture in prints.values()}) == len(prints)
    inner = {
        material: picture[20:-20, 20:-20].astype(float) for material, picture in prints.items()
    }
    for first, other in combinations(
        inner.values(), 2
    ):  # prints of one brightness that a pixel of 3 mm still shows
        coarse = [
            (p / p.mean())[:216, :216, 0].reshape(54, 4, 54, 4).mean(axis=(1, 3))
            for p in (first, other)
        ]
        assert np.std(coarse[0] - coarse[1]) > 0.035
    for picture in prints.values():
        assert 120 < picture.mean() < 210
        assert decoded(picture).max() <= 0.853  # of 255 levels
