"""The textile laboratory reads what a fabric was made with."""

import numpy as np
import pytest

from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import fabric, isotropic
from stickslip_sim_core.lab.cantilever import cantilever
from stickslip_sim_core.lab.drape import (
    DISC_RADIUS,
    PEDESTAL_RADIUS,
    count_folds,
    drape,
    refined,
    shadow_beyond_pedestal,
)
from stickslip_sim_core.lab.picture import drape_svg
from stickslip_sim_core.lab.pull import pull
from stickslip_sim_core.lab.tilt import tilt

OVERHANG = np.pi * (DISC_RADIUS**2 - PEDESTAL_RADIUS**2)


@pytest.mark.parametrize("spacing", [0.02, 0.007])
def test_a_ring_is_covered_once_by_triangles_that_are_not_flat(spacing: float) -> None:
    ring = meshes.ring(PEDESTAL_RADIUS, DISC_RADIUS, spacing, seed=3)
    a, b, c = (ring.mesh.rest[ring.mesh.triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    areas = 0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    assert areas.min() > 0.2 * 0.5 * 0.866 * spacing**2
    # Polygons stand for circles, inside of them.
    radius = np.hypot(*ring.mesh.rest.T)
    whole = np.pi * (radius.max() ** 2 - radius.min() ** 2)
    assert areas.sum() == pytest.approx(whole, rel=0.01)
    # Two circles are clamped, one on each side of the edge of the pedestal.
    clamped = radius[radius < ring.clamped]
    assert clamped.min() < PEDESTAL_RADIUS < clamped.max()
    assert len(np.unique(np.round(clamped, 9))) == 2


def test_a_ring_needs_three_cells() -> None:
    with pytest.raises(ValueError, match="spacing: must be at most a third of the width"):
        meshes.ring(0.09, 0.15, 0.03)


def test_a_flat_disc_has_all_of_its_shadow() -> None:
    ring = meshes.ring(PEDESTAL_RADIUS, DISC_RADIUS, 0.005).mesh
    flat = np.column_stack([ring.rest, np.zeros(len(ring.rest))])
    assert shadow_beyond_pedestal(flat, ring.triangles) / OVERHANG == pytest.approx(1.0, abs=0.003)
    # What folds back under the disc has no shadow of its own.
    assert shadow_beyond_pedestal(
        np.concatenate([flat, flat]), np.concatenate([ring.triangles, ring.triangles + len(flat)])
    ) == shadow_beyond_pedestal(flat, ring.triangles)


@pytest.mark.parametrize("folds", [3, 8])
def test_folds_are_counted(folds: int) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    radius = 0.13 + 0.01 * np.cos(folds * angle)
    rim = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * angle])
    assert count_folds(np.random.default_rng(0).permutation(rim)) == folds


@pytest.mark.physics
def test_a_stiff_disc_drapes_less_than_a_soft_one() -> None:
    draped = [drape(isotropic(0.2, 500.0, rigidity), cell=0.015) for rigidity in (1e-2, 5e-5, 5e-6)]
    assert all(each.at_rest for each in draped)
    stiff, middle, soft = (each.coefficient for each in draped)
    # A plate of this rigidity hardly bends over 6 cm.
    assert stiff > 97.0
    assert stiff > middle > soft > 20.0


@pytest.mark.physics
def test_a_refined_drape_has_the_folds_of_the_coarser_one() -> None:
    cloth = isotropic(0.2, 500.0, 5e-5)
    coarse, other = (drape(cloth, cell=0.015, seed=seed) for seed in (1, 2))
    draped = drape(cloth, cell=0.0075, seed=2, coarser=coarse)
    assert draped.at_rest
    assert draped.unconverged == 0
    # The bumps of its own seed would have chosen others.
    assert draped.folds == coarse.folds != other.folds
    assert draped.coefficient == pytest.approx(coarse.coefficient, abs=2.0)


def test_a_refined_drape_begins_on_the_coarser_one() -> None:
    coarse = drape(isotropic(0.2, 500.0, 1e-2), cell=0.02)
    middles = coarse.flat[coarse.triangles].mean(axis=1)
    expected = coarse.positions[coarse.triangles].mean(axis=1)
    np.testing.assert_allclose(refined(coarse, middles), expected, atol=1e-12)
    np.testing.assert_allclose(refined(coarse, coarse.flat), coarse.positions, atol=1e-12)


def test_a_draped_disc_has_a_picture() -> None:
    picture = drape_svg(drape(isotropic(0.2, 500.0, 1e-2), cell=0.02))
    assert picture.startswith("<svg")
    assert "drape coefficient" in picture
    assert picture.count("<polygon") > 100


@pytest.mark.parametrize("direction", ["warp", "weft"])
@pytest.mark.parametrize("name", ["gray-interlock", "royal-target"])
def test_a_cantilever_reads_the_bending_length_of_its_fabric(name: str, direction: str) -> None:
    measured = cantilever(fabric(name), direction)  # type: ignore[arg-type]
    stated = np.cbrt(measured.stated_rigidity / (measured.density * 9.81))
    assert measured.bending_length == pytest.approx(stated, rel=2e-3)
    assert measured.rigidity == pytest.approx(measured.stated_rigidity, rel=6e-3)


@pytest.mark.parametrize("mu", [0.2, 0.6])
def test_a_tilting_table_reads_mu(mu: float) -> None:
    # The table tilts by 1 degree in a second, and the sheet needs a while for 0.1 mm.
    slipped = tilt(fabric("camel-ponte-roma"), mu)
    assert 0.0 <= np.degrees(slipped.angle - np.arctan(mu)) < 0.3


def test_a_pull_over_a_cylinder_reads_mu() -> None:
    # The stiffness of the strip, which the formula of the capstan leaves out, is a few per cent.
    assert pull(fabric("gray-interlock"), 0.4).read_mu == pytest.approx(0.4, rel=0.03)
