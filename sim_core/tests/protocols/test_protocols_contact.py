"""Protocols of cloth with cloth and of friction around a cylinder, small."""

import numpy as np
import pytest
from stickslip_testing.drums import OverTriangles

from stickslip_sim_core import SelfContact, cylinder, preset_named, protocols
from stickslip_sim_core.protocols import capstan, heavy_fold, pull_out
from stickslip_sim_core.reference import master_curves

pytestmark = pytest.mark.physics


class TestCapstan:
    def test_measures_tensions(self) -> None:
        result = protocols.run("capstan", friction=(0.1, 0.8), bending=(0.05,))
        assert result.passed
        assert result.settings["unconverged_steps"] == 0
        assert result.settings["ripple"] < 0.01  # type: ignore[operator]

    def test_a_smoother_cylinder_is_seen(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(capstan, "cylinder", lambda mu, *a, **k: cylinder(0.99 * mu, *a, **k))
        assert not protocols.run("capstan", friction=(0.3,), bending=(0.05,)).passed

    @pytest.mark.parametrize("facets", [36, 60])
    def test_facets_are_not_felt(self, facets: int) -> None:
        strip = OverTriangles(0.3, 0.05, preset_named("certified"), facets)
        heavy, wrap = strip.draw()
        measured, expected = (
            np.log(heavy.mean() / capstan.LIGHT),
            np.log(master_curves.capstan(0.3, wrap, 0.05)),
        )
        assert measured == pytest.approx(expected, rel=3e-3)
        assert np.ptp(heavy) < 0.01 * heavy.mean()
        assert strip.cloth.total.newton <= 10 * strip.cloth.total.steps
        assert strip.cloth.total.unconverged == 0

    def test_radius(self) -> None:
        with pytest.raises(ValueError, match="radius: must be finite and > 0"):
            cylinder(0.5, 0.0)


class TestHeavyFold:
    def test_has_its_shape_and_does_not_drift(self) -> None:
        result = protocols.run("heavy-fold", friction=(0.5,), cells=80)
        assert result.passed
        assert result.settings["drift_mm"] < 1e-5  # type: ignore[operator]
        assert result.settings["unconverged_steps"] == 0
        assert result.settings["least_distance_over_thickness"] > 0.9  # type: ignore[operator]

    def test_an_upper_layer_that_slips_too_soon_is_seen(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(
            heavy_fold, "SelfContact", lambda mu, thickness: SelfContact(0.97 * mu, thickness)
        )
        result = protocols.run("heavy-fold", friction=(0.5,), cells=80)
        assert not result.passed
        assert [max(map(abs, curve.errors)) < result.tolerance for curve in result.curves] == [
            True,
            True,
            False,
        ]

    def test_one_that_does_not_come_to_rest_has_no_shape(
        self, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(heavy_fold, "STEPS_MAX", 3)
        monkeypatch.setattr(heavy_fold, "HOLD_TIME", 0.0)
        assert not protocols.run("heavy-fold", friction=(0.5,), cells=40).passed


class TestPullOut:
    def test_measures_both_sides(self) -> None:
        result = protocols.run("pull-out", friction=(0.3,), loads=(1.0,), cells=4)
        assert result.error < 1e-4
        assert result.settings["unconverged_steps"] == 0

    def test_a_lowest_sheet_that_moves_is_seen(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(pull_out, "ROUGH", 0.0)
        monkeypatch.setattr(pull_out, "SLIDING", 0.2)
        monkeypatch.setattr(pull_out, "MEASURED", 0.1)
        assert not protocols.run(
            "pull-out", friction=(0.3,), loads=(1.0,), cells=3, unstructured=0
        ).passed
