"""The cloth that is seen lies about the solver's, and its hem and creases are as strong as asked
for.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from stickslip_blender.cloth.surface import CREASE, FINE_VERTICES, Surface


def _flat(sheet: Any, height: float) -> Any:
    return np.column_stack([sheet.rest, np.full(len(sheet.rest), height)])


def test_a_hem_is_as_thick_as_asked_for_and_goes_all_around(make_sheet: Callable[..., Any]) -> None:
    sheet = make_sheet(21)
    surface = Surface(sheet.triangles, sheet.rest)
    surface.apply_relief(hem=0.001)
    points = surface(_flat(sheet, 0.1))
    hem = points[surface._count :]
    assert surface._count >= FINE_VERTICES
    assert hem[:, 2].max() == pytest.approx(0.101)
    assert hem[:, 2].min() == pytest.approx(0.099)
    outermost = np.abs(hem[:, :2]).max(axis=1)
    assert outermost.max() == pytest.approx(0.1003, abs=1e-5)
    assert outermost.min() == pytest.approx(0.1 - 0.0065, abs=1e-5)
    # Closed: every edge of the hem but those of its inner ends belongs to two triangles.
    faces = surface.triangles[(surface.triangles >= surface._count).all(axis=1)]
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(sides, axis=0, return_counts=True)
    assert (uses == 1).sum() == 2 * (len(hem) // 7)
    assert surface.uv.min() == 0.0
    assert surface.uv.max() == 1.0


def test_creases_are_seeded_and_not_stronger_than_their_label(sheet: Any) -> None:
    surface = Surface(sheet.triangles, sheet.rest)
    plain = surface(_flat(sheet, 0.1))
    heights = []
    for strength, seed in ((1.0, 1), (0.5, 1), (1.0, 2)):
        surface.apply_relief(hem=0.0, creases=strength, seed=seed)
        heights.append((surface(_flat(sheet, 0.1)) - plain)[: surface._count, 2])
    assert 0.5 * CREASE < np.abs(heights[0]).max() <= CREASE * (1.0 + 1e-9)
    np.testing.assert_allclose(heights[1], 0.5 * heights[0], atol=1e-12)
    assert np.abs(heights[0] - heights[2]).max() > 0.3 * CREASE
    on_floor = surface(_flat(sheet, 0.0))[: surface._count]
    assert on_floor[:, 2].min() == 0.0  # nothing is pressed into the floor
