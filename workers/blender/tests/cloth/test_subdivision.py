"""Subdivision: Loop's rules, on meshes where their outcome is known."""

from typing import Any

import numpy as np
import pytest
from stickslip_blender.cloth.surface import subdivide


def test_every_triangle_becomes_four(sheet: Any) -> None:
    fine = subdivide(sheet.triangles, sheet.rest)
    assert fine.triangles.shape == (4 * 128, 3)
    assert len(fine(sheet.rest)) == 17 * 17
    assert sorted(np.unique(fine.triangles)) == list(range(17 * 17))


def test_a_flat_regular_sheet_stays_what_it_is(sheet: Any) -> None:
    """All rules keep linear functions where the mesh is regular: areas and outline, too."""
    fine = subdivide(sheet.triangles, sheet.rest)
    flat = fine(sheet.rest)
    line = np.linspace(-0.1, 0.1, 17)
    order = np.lexsort(flat.round(4).T)
    np.testing.assert_allclose(flat[order], [(x, y) for y in line for x in line], atol=1e-7)
    a, b, c = (flat[fine.triangles[:, i]] for i in range(3))
    areas = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    np.testing.assert_allclose(areas, 0.04 / 512, rtol=1e-5)  # and none is turned over


def test_nothing_gets_below_the_floor(sheet: Any) -> None:
    heights = np.abs(np.random.default_rng(0).standard_normal((81, 1)))
    assert subdivide(sheet.triangles, sheet.rest)(heights).min() >= 0.0


def test_the_inner_rule_is_that_of_loop(sheet: Any) -> None:
    """A spike on a vertex of valence 6 keeps 1 - 6/16 of its height and gives its neighbours 1/16
    each [Loop 1987].
    """
    middle = 4 * 9 + 4
    spike = np.zeros((81, 1))
    spike[middle] = 1.0
    fine = subdivide(sheet.triangles, sheet.rest)(spike)[:, 0]
    assert fine[middle] == pytest.approx(10 / 16)
    assert sorted(fine[:81][fine[:81] > 0].round(9).tolist())[:6] == [1 / 16] * 6
    assert sorted(np.unique(fine[81:].round(9)).tolist()) == [0.0, 1 / 8, 3 / 8]


def test_corners_stay(sheet: Any) -> None:
    fine = subdivide(sheet.triangles, sheet.rest)
    bent = np.random.default_rng(1).standard_normal((81, 3))
    for corner in (0, 8, 72, 80):
        np.testing.assert_allclose(fine(bent)[corner], bent[corner])


def test_a_mesh_that_branches_is_refused() -> None:
    with pytest.raises(
        ValueError, match="every edge must belong to one or two triangles; one belongs to 3"
    ):
        subdivide([(0, 1, 2), (0, 1, 3), (0, 1, 4)], np.random.default_rng(0).random((5, 2)))
