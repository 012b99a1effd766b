"""The rod solver on the physical protocols, and what a result says."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stickslip_sim_core import _sim_core, build_info, protocols, solve_rods
from stickslip_sim_core.protocols import Curve, ProtocolResult, rods
from stickslip_sim_core.protocols.result import dense_master
from stickslip_sim_core.protocols.rods import (
    extrapolated,
    loss_of_stability,
    planar_frames,
    round_rod,
    tip,
)
from stickslip_sim_core.reference import master_curves

pytestmark = pytest.mark.physics


class TestBendTwist:
    @pytest.mark.parametrize(
        "phi", [(10.0, 25 * np.pi), pytest.param((6.0,), marks=pytest.mark.slow)]
    )
    def test_passes(self, phi: tuple[float, ...]) -> None:
        """Near the onset it takes twice as long as at the other two together."""
        result = protocols.run("bend-twist", phi=phi)
        assert result.passed
        assert result.error < 1e-7  # asked: 1e-4; aim: 1e-6
        assert [curve.parameters["poisson"] for curve in result.curves] == [0.0, 0.3, 0.5]

    def test_rod_that_is_always_planar(self) -> None:
        """At poisson = 0 a rod of phi = 6 is below the onset: solver and master curve agree that
        there is nothing.
        """
        result = protocols.run("bend-twist", phi=(6.0,), poisson=(0.0,), elements=128)
        assert math.isnan(result.curves[0].measured[0])
        assert math.isnan(result.curves[0].master[0])
        assert result.passed

    def test_error_falls_with_the_square_before_extrapolation(self) -> None:
        limit = rods.upper_boundary(10.0, 0.5, 1024)
        errors = [rods.upper_boundary(10.0, 0.5, n) - limit for n in (64, 128)]
        assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)

    def test_lower_boundary_meets_the_upper_at_the_onset(self) -> None:
        def lower_boundary(phi: float, poisson: float, elements: int) -> float:
            """Return the weight at which the chain, followed upwards from its natural shape, loses
            stability.
            """
            relax = round_rod(phi, poisson)
            start = relax(1e-2, planar_frames(phi * np.linspace(0.0, 1.0, elements + 1)))
            assert start.stable
            return loss_of_stability(
                relax, start, 1e-2 * 1.05 ** np.arange(1, np.ceil(np.log(phi**3 / 1e-2) / 0.0488))
            )

        upper, lower = (f(5.57, 0.5, 256) for f in (rods.upper_boundary, lower_boundary))
        assert 0.75 * upper < lower < upper

    def test_certificate_is_that_of_solve_rods(self) -> None:
        """Just above and below the measured boundary, solve_rods says the same of planar rods."""
        boundary = rods.upper_boundary(6.0, 0.5, 128)
        solved = solve_rods([boundary * 0.999, boundary * 1.001], [0.0, 0.0], [6.0, 6.0])
        assert solved.converged.all()
        assert solved.stable.tolist() == [False, True]


class TestRodCantilever:
    def test_passes(self) -> None:
        result = protocols.run("rod-cantilever")
        assert result.passed
        assert result.error < 1e-6

    def test_coarse_chain_fails(self) -> None:
        assert not protocols.run("rod-cantilever", elements=64).passed


class TestRodLateralBuckling:
    def test_passes(self) -> None:
        result = protocols.run("rod-lateral-buckling")
        assert result.passed
        assert result.error < 1e-8

    def test_strip_that_bends_in_its_plane_buckles_later(self) -> None:
        weights = [rods.buckling_weight(0.3, ratio, 64) for ratio in (1e2, 1e3, 1e4)]
        assert weights[0] > weights[1] > weights[2]


class TestCertification:
    @pytest.mark.parametrize("preset", sorted(protocols.CERTIFICATION))
    def test_names_protocols_and_numbers(self, preset: str) -> None:
        certification = protocols.CERTIFICATION[preset]
        assert certification.protocols
        assert set(certification.protocols) <= set(protocols.PROTOCOLS)
        assert set(certification.quick) <= set(protocols.PROTOCOLS)
        json.dumps(dict(certification.numbers()), allow_nan=False)

    def test_rods_take_no_notice_of_a_preset(self) -> None:
        first, second = (
            protocols.run("rod-cantilever", preset, gamma=(1.0,), elements=64)
            for preset in (None, "x")
        )
        assert first == second

    def test_others_are_given_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        class Pretended:
            def __init__(self, *, preset: str = "certified", cells: int = 50) -> None:
                self.settings = preset, cells

            def run(self) -> Any:
                return self.settings

        monkeypatch.setattr(protocols, "PROTOCOLS", {"pretended": Pretended})
        results: list[Any] = [
            protocols.run("pretended"),
            protocols.run("pretended", "fast", cells=7),
        ]
        assert results == [("certified", 50), ("fast", 7)]


class TestRelax:
    def test_agrees_with_solve_rods(self) -> None:
        """From its own natural shape a chain relaxes to the rod that solve_rods extrapolates to."""

        def height(n: int) -> float:
            natural = planar_frames(6.0 * np.linspace(0, 1, n + 1))
            return float(tip(round_rod(6.0, 0.5)(300.0, natural).frames)[2])

        limit = solve_rods([300.0], [0.0], [6.0], elements=512).centerline[0, -1, 2]
        assert extrapolated(height, 512) == pytest.approx(limit, abs=1e-9)

    def test_saddle_is_not_stable(self) -> None:
        assert not round_rod(12.0, 0.5)(100.0, planar_frames(np.zeros(129))).stable

    def test_clamp_stays(self) -> None:
        frames = planar_frames(np.full(33, 1.0))
        assert (round_rod(0.0, 0.5)(5.0, frames).frames[0] == frames[0]).all()

    def test_single_frame_is_refused(self) -> None:
        with pytest.raises(ValueError, match="quaternions: must have at least 2 rows, got 1"):
            _sim_core.relax_rod(1.0, 0.0, 0.0, 1.0, np.array([[1.0, 0.0, 0.0, 0.0]]))


class TestResult:
    RESULT = ProtocolResult(
        "bend-twist",
        "phi",
        "Gamma",
        (Curve({}, (1.0, 2.0), (1.1, math.nan), (1.0, math.nan)),),
        0.2,
        {"n": 4},
        "0" * 64,
    )

    def test_errors(self) -> None:
        assert self.RESULT.curves[0].errors == pytest.approx((0.1, 0.0))
        assert self.RESULT.passed
        assert not replace(self.RESULT, tolerance=0.05).passed

    def test_a_step_that_did_not_converge_fails(self) -> None:
        """Also where the errors are small: a step above the tolerance is no measurement."""
        assert replace(self.RESULT, settings={"unconverged_steps": 0}).passed
        assert not replace(self.RESULT, settings={"unconverged_steps": 1}).passed

    def test_missing_measurement_fails(self) -> None:
        one_sided = Curve({}, (1.0,), (math.nan,), (1.0,))
        result = replace(self.RESULT, curves=(one_sided,))
        assert not result.passed
        assert result.as_dict()["error"] is None

    def test_nothing_measured_fails(self) -> None:
        assert not protocols.run("rod-cantilever", gamma=()).passed

    def test_json(self) -> None:
        text = json.dumps(
            protocols.run("rod-cantilever", gamma=(1.0,), elements=64).as_dict(), allow_nan=False
        )
        assert json.loads(text)["build_hash"] == build_info().build_hash
        assert json.loads(json.dumps(self.RESULT.as_dict(), allow_nan=False))["curves"][0][
            "measured"
        ] == [1.1, None]

    def test_unknown_names_and_settings(self) -> None:
        with pytest.raises(
            ValueError, match=r"protocol: must be one of bend-twist, .* got 'stick'"
        ):
            protocols.run("stick")
        with pytest.raises(TypeError):
            protocols.run("rod-cantilever", speed=1)
        with pytest.raises(ValueError, match="elements: must be a multiple of 4"):
            protocols.run("rod-cantilever", elements=33)


class TestDenseCurves:
    """Master curves as they are drawn: through the exact values, and smooth between them."""

    def test_formulas_are_exact_and_one_point_has_a_curve(self) -> None:
        curve = Curve({}, (2.0,), (0.2,), (float(master_curves.cantilever(np.array([2.0]))[0]),))
        x, y = dense_master("cantilever", curve)
        assert len(x) == 200
        assert (x[0], x[-1]) == pytest.approx((2.0 / 1.5, 3.0))
        np.testing.assert_allclose(y[::20], master_curves.cantilever(x[::20]))

    def test_a_smooth_curve_goes_through_the_exact_values(self) -> None:
        ratio = (0.1, 0.02, 0.5)  # in any order
        curve = Curve({"poisson": 0.3}, ratio, (1.0, 1.0, 1.0), (14.0, 13.0, np.nan))
        x, y = dense_master("lateral-buckling", curve)
        assert (x[0], x[-1]) == pytest.approx((0.02, 0.1))
        assert (y[0], y[-1]) == pytest.approx((13.0, 14.0))
        assert (np.diff(y) > 0).all()
        assert [
            len(part)
            for part in dense_master("lateral-buckling", Curve({}, (1.0,), (1.0,), (2.0,)))
        ] == [1, 1]
