"""The cloth solver on the physical protocols, with small settings.

The full ones are those of certificates.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from stickslip_sim_core import PRESETS, preset_named, protocols
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.protocols import (
    Curve,
    ProtocolResult,
    cantilever,
    inclined_plane,
    lateral_buckling,
    motion,
    oscillation,
    stick_slip,
)
from stickslip_sim_core.protocols.protocol import LENGTH, strip
from stickslip_sim_core.protocols.result import Refinement
from stickslip_sim_core.reference import master_curves
from stickslip_sim_core.reference.oscillation import shaken_block

pytestmark = pytest.mark.physics

CERTIFIED = preset_named("certified")


@pytest.fixture(scope="module")
def pressed() -> ProtocolResult:
    return protocols.run(
        "stick-slip", friction=(0.1, 0.3), cells=(8, 12, 30), structured=1, unstructured=0
    )


class TestStickSlip:
    def test_passes(self, pressed: ProtocolResult) -> None:
        """On meshes that are too coarse for the limit."""
        assert pressed.error < 4e-3
        static = pressed.settings["static_ratio_error"]
        assert isinstance(static, float)
        assert static < 2e-3

    def test_phases(self, pressed: ProtocolResult) -> None:
        """Every point of the diagram is where the master curve says, but for those on its very
        line.
        """
        columns = [pressed.settings[f"phase_{name}"] for name in ("mu", "strain", "regime")]
        mu, strain, regime = (np.array(column) for column in columns)
        strain_c, mu_c = master_curves.stick_slip_triple_point()
        for m in np.unique(mu):
            threshold = float(master_curves.stick_slip_strain(m)) if m < mu_c else strain_c
            beyond = stick_slip.SLIP if m < mu_c else stick_slip.EXTENDED
            clear = (mu == m) & (np.abs(strain - threshold) > 0.012)
            assert (
                regime[clear] == np.where(strain[clear] > threshold, beyond, stick_slip.STICK)
            ).all()
        assert set(regime) == {stick_slip.STICK, stick_slip.SLIP, stick_slip.EXTENDED}

    @pytest.mark.parametrize("preset", ["fast", "certified", "fine"])
    @pytest.mark.parametrize("onset", [0.05, 0.25, 0.5])
    def test_half_a_step_is_far_below_the_tolerance_of_the_limit(
        self, preset: str, onset: float
    ) -> None:
        """Extrapolation doubles what the finest mesh lacks."""
        time_step = preset_named(preset).time_step
        half_a_step = 0.5 * time_step * stick_slip.growth_rate(time_step, onset) / onset

        assert 2.0 * half_a_step <= 0.5 * stick_slip.StickSlip.limit_tolerance

    def test_friction_beyond_the_triple_point_is_refused(self) -> None:
        with pytest.raises(ValueError, match="friction: "):
            protocols.run("stick-slip", friction=(0.4,))


class TestCantilever:
    def test_passes(self) -> None:
        """Without a clamp by two rows, H/W at 30 and 25 cells was off by 0.4 %."""
        result = protocols.run("cantilever", gamma=(0.01, 30.0), cells=(10, 20, 40), unstructured=1)
        assert result.passed
        for curve in result.curves:
            assert curve.refinement is not None
            assert curve.refinement.order[0] == pytest.approx(2.0, abs=0.5)
            assert abs(curve.limit_errors[0]) < 0.2 * abs(curve.errors_by_mesh[1][0])

    @pytest.mark.slow
    def test_locking_is_seen(self) -> None:
        """Ten times as stiff against stretching as it should be, an unstructured mesh is not passed
        at a sharp bend.
        """
        loose = strip(0.02, 25, 0)
        good, bad = (cantilever.hang(loose, 300.0, CERTIFIED, Y)[0] for Y in (3e3, 1e6))
        exact = float(master_curves.cantilever(300.0))
        assert abs(good / exact - 1.0) < abs(bad / exact - 1.0)

    def test_what_does_not_settle_is_nan(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(cantilever, "STEPS_MAX", 20)
        result = protocols.run("cantilever", gamma=(1.0,), cells=(8, 12, 18), unstructured=0)
        assert math.isnan(result.curves[0].measured[0])
        assert not result.passed


class TestLateralBuckling:
    def test_passes(self) -> None:
        result = protocols.run(
            "lateral-buckling", aspect=(0.2,), cells=(8, 14, 28), structured=1, unstructured=1
        )
        assert result.error < 1e-2

    @pytest.mark.parametrize(("share", "falls"), [(0.97, False), (1.03, True)])
    def test_it_is_where_the_solver_buckles(self, share: float, falls: bool) -> None:
        """A sideways push of 1e-5 g turns a strip 3 % heavier than the threshold, and leaves one 3
        % lighter.
        """
        clamped = strip(0.02, 20, "alternating")
        gamma = share * lateral_buckling.threshold(clamped, 0.0, CERTIFIED)[0]
        cloth, flat = lateral_buckling.loaded(
            clamped, 0.0, 0.2 * GRAVITY * LENGTH**3 / gamma, CERTIFIED
        )
        cloth.gravity[:, 2] = 1e-5 * GRAVITY
        for _ in range(1000):
            cloth.step(0.02, held=flat[clamped.held], damping=5.0)
        sideways = float(np.abs(cloth.positions[clamped.tip, 2]).max()) / LENGTH
        assert (sideways > 0.03) if falls else (sideways < 1e-3)


class TestLimits:
    def test_of_a_power(self) -> None:
        sizes = ((0.1,), (0.06,), (0.03,))
        refinement = Refinement.of(
            ((10.0,), (17.0,), (33.0,)), sizes, tuple((3.0 + 2.0 * h**1.7,) for (h,) in sizes)
        )
        assert refinement.limit[0] == pytest.approx(3.0)
        assert refinement.order[0] == pytest.approx(1.7)

    def test_without_an_order(self) -> None:
        """Values that go to and fro: the order is that of theory, and the certificate gives the one
        of theory.
        """
        refinement = Refinement.of(
            ((10.0,), (20.0,), (40.0,)), ((0.4,), (0.2,), (0.1,)), ((1.0,), (1.3,), (1.2,))
        )
        assert math.isnan(refinement.order[0])
        assert refinement.limit[0] == pytest.approx(1.2 - 0.1 / 3.0)

    def test_a_wrong_limit_fails(self) -> None:
        refinement = Refinement(((1.0,),) * 3, ((1.0,),) * 3, (1.002,), (2.0,))
        curve = Curve({}, (1.0,), (1.0,), (1.0,), refinement)
        assert not ProtocolResult("p", "x", "y", (curve,), 4e-3, {}, "0", 1e-3).passed
        assert ProtocolResult("p", "x", "y", (curve,), 4e-3, {}, "0", 3e-3).passed

    def test_meshes_that_are_alike_are_refused(self) -> None:
        with pytest.raises(ValueError, match="cells: must be three"):
            protocols.run("cantilever", cells=(20, 22, 40))


class TestInclinedPlane:
    def test_passes(self) -> None:
        result = protocols.run("inclined-plane", friction=(0.1, 1.5), cells=6)
        assert result.passed
        assert result.error < 1e-3
        # A start of other rounding is all that differs.
        assert result.settings["drift_mm"] < 1e-12  # type: ignore[operator]

    def test_creep_is_not_passed(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(inclined_plane.OnSlope, "drift", lambda _: 2e-5)
        result = protocols.run("inclined-plane", friction=(0.5,), cells=4, unstructured=0)
        assert math.isnan(result.curves[0].measured[0])
        assert not result.passed

    def test_patch_that_does_not_slide_is_nan(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(inclined_plane.OnSlope, "share_to", 0.99)
        mesh = meshes.grid(0.1, 0.1, 4, 4)
        assert math.isnan(inclined_plane.patch(mesh, 0.5, CERTIFIED).slip_slope())

    def test_slips_late_by_the_tolerance(self) -> None:
        """A residual that is as good as zero for the solver is friction beyond mu: tolerance over
        mu at most.
        """
        mesh = meshes.grid(0.1, 0.1, 4, 4)
        loose = replace(CERTIFIED, tolerance=1e-2)
        late = [
            inclined_plane.patch(mesh, 0.5, preset).slip_slope() / 0.5 - 1.0
            for preset in (loose, CERTIFIED)
        ]
        assert 0.0 < late[1] < late[0] < 1e-2 / 0.5 * 1.5


class TestMotion:
    @pytest.mark.parametrize("name", ["fall", "slide-to-rest", "impact", "shaken-floor"])
    @pytest.mark.parametrize("preset", ["fast", "certified"])
    def test_passes(self, name: str, preset: str) -> None:
        result = protocols.run(name, preset)
        assert result.passed
        assert result.settings["unconverged_steps"] == 0

    @pytest.mark.parametrize(
        ("name", "factor"), [("fall", 1.005), ("slide-to-rest", 1.005), ("impact", 1.02)]
    )
    def test_fails_for_a_wrong_gravity(
        self, name: str, factor: float, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(motion, "GRAVITY", factor * GRAVITY)
        assert not protocols.run(name).passed

    @pytest.mark.parametrize("preset", ["fast", "certified", "fine"])
    def test_a_swing_passes(self, preset: str) -> None:
        assert protocols.run("swing", preset).passed

    def test_the_swing_fails_where_the_scheme_damps_it(self) -> None:
        result = oscillation.Swing(preset=replace(CERTIFIED, second_order=False)).run()
        assert not result.passed
        assert result.error > 0.1

    def test_the_floor_fails_for_other_friction(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(oscillation, "MU", 0.8)

        def as_before(frequency: float, size: float, _mu: float, until: float) -> float:
            return shaken_block(frequency, size, 1.0, until)

        monkeypatch.setattr(oscillation, "shaken_block", as_before)
        assert not protocols.run("shaken-floor").passed


class TestPresets:
    @pytest.mark.parametrize("preset", sorted(PRESETS))
    def test_every_preset_names_the_protocols(self, preset: str) -> None:
        certification = protocols.CERTIFICATION[preset]
        always = {
            "fall",
            "slide-to-rest",
            "static-onset",
            "kinetic-slide",
            "impact",
            "gripper",
            "stick-slip",
            "cantilever",
            "soft-cantilever",
            "lateral-buckling",
            "inclined-plane",
        }
        # Fixed steps do not resolve these, or take hours.
        of_scenes = {
            "shaken-floor",
            "capstan",
            "edge",
            "heavy-fold",
            "stacked-incline",
            "pull-out",
            "swing",
        }
        expected = always if preset.startswith("thesis-") else always | of_scenes
        assert set(certification.protocols) == expected
        assert certification.numbers()["time_step"] == PRESETS[preset].time_step

    @pytest.mark.parametrize(
        "preset", ["thesis-high", "thesis-low-small-dt", "thesis-low-big-dt", "fast"]
    )
    def test_every_preset_is_run(self, preset: str) -> None:
        """With whatever outcome, and in JSON's types."""
        result = protocols.run(
            "lateral-buckling",
            preset,
            aspect=(0.2,),
            poisson=(0.0,),
            cells=(8, 12, 18),
            unstructured=0,
        )
        assert result.settings["preset"] == preset
        json.dumps(result.as_dict(), allow_nan=False)

    def test_unknown_preset(self) -> None:
        for name in protocols.CERTIFICATION["certified"].protocols:
            with pytest.raises(ValueError, match="preset: must be one of certified"):
                protocols.run(name, "best")
