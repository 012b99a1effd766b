"""Master curves against shooting, against limits, and against their own definitions."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root
from scipy.special import jv

from stickslip_sim_core.reference import bend_twist, boundary_values, master_curves

Floats = NDArray[np.float64]


class TestCantilever:
    @pytest.mark.physics
    @pytest.mark.parametrize("gamma", [1e-3, 0.5, 30.0, 300.0])
    def test_against_shooting(self, gamma: float) -> None:
        """From the free end, from where psi grows towards the clamp."""

        def rate(x: float, y: Floats) -> Floats:
            return np.array([y[1], gamma * x * np.sin(y[0]), np.cos(y[0]), np.sin(y[0])])

        def shoot(log_tip: float) -> Floats:
            start = [np.exp(log_tip), 0, 0, 0]
            return np.asarray(
                solve_ivp(rate, (0, 1), start, method="DOP853", rtol=1e-12, atol=1e-15).y[:, -1]
            )

        tip = brentq(
            lambda tip: shoot(tip)[0] - np.pi / 2, -np.sqrt(gamma), np.log(np.pi / 2), xtol=1e-14
        )
        _, _, drop, reach = shoot(tip)
        assert master_curves.cantilever(gamma) == pytest.approx(drop / reach, rel=1e-8)

    def test_light_rod_is_a_beam(self) -> None:
        assert master_curves.cantilever(1e-3) == pytest.approx(1e-3 / 8, rel=1e-6)

    def test_heavy_rod(self) -> None:
        """Short of sqrt(gamma / 2) by 4.6 % at 1e3 and 0.45 % at 1e5."""
        ratio = master_curves.cantilever([1e3, 1e5]) / np.sqrt([1e3 / 2, 1e5 / 2])
        np.testing.assert_allclose(ratio - 1, [-0.046, -0.0045], rtol=0.02)

    def test_refined(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A hundred times the tolerance changes nothing above 1e-8: the remaining error is far
        below.
        """
        gamma = 10.0 ** np.arange(-3.0, 5.1)
        fine = master_curves.cantilever(gamma)
        monkeypatch.setattr(boundary_values, "TOLERANCE", 1e-7)
        coarse = master_curves.cantilever(gamma)
        np.testing.assert_allclose(coarse, fine, rtol=1e-9)
        assert (coarse != fine).any()

    def test_grows(self) -> None:
        assert (np.diff(master_curves.cantilever(np.geomspace(1e-3, 1e5, 30))) > 0).all()


def test_lateral_buckling_rod() -> None:
    zero = brentq(lambda z: jv(-1 / 6, z), 2.0, 2.3, xtol=1e-15)
    assert master_curves.lateral_buckling_rod() == pytest.approx(6 * zero, rel=1e-14)
    assert master_curves.lateral_buckling_rod() == pytest.approx(12.8538, abs=5e-5)


@pytest.mark.physics
class TestLateralBuckling:
    """Of a plate strip; how it is solved has tests of its own in test_plate_buckling.py."""

    @pytest.mark.slow
    @pytest.mark.parametrize("poisson", [0.0, 0.3, 0.5])
    def test_narrow_strip_is_a_rod(self, poisson: float) -> None:
        rod = master_curves.lateral_buckling_rod() * np.sqrt(2 / (1 + poisson)) * (1 - poisson**2)
        excess = master_curves.lateral_buckling([0.01, 0.02], poisson) / rod - 1
        assert 0 < excess[0] < 0.01
        assert 2 * excess[0] - excess[1] == pytest.approx(0, abs=4e-4)  # the limit at aspect 0

    def test_wide_strip_is_stiffer(self) -> None:
        weights = master_curves.lateral_buckling([0.05, 0.2, 1.0], 0.3)
        np.testing.assert_allclose(weights, [15.0621, 16.9965, 29.815], rtol=5e-5)


class TestStickSlip:
    @pytest.mark.parametrize("strain", [1e-3, 0.05, 0.2, 0.33])
    def test_against_shooting(self, strain: float) -> None:
        """In theta itself, with scipy."""

        def miss(p: Floats) -> Floats:
            def rate(_: float, y: Floats) -> Floats:
                return np.array(
                    [y[1], p[0] * np.cos(y[0]) + p[1] * np.sin(y[0]), np.cos(y[0]), np.sin(y[0])]
                )

            y = solve_ivp(
                rate, (0, 1), [np.pi / 2, p[2], 0, 0], method="DOP853", rtol=1e-13, atol=1e-14
            ).y[:, -1]
            return np.array([y[1], y[2], y[3] - 1 + strain])

        load = 20.19
        solution = root(
            miss, [load, 0.48 * np.sqrt(strain) * load, -9.0 * np.sqrt(strain)], tol=1e-13
        )
        assert np.abs(solution.fun).max() < 1e-11
        assert master_curves.stick_slip(strain) == pytest.approx(
            solution.x[1] / solution.x[0], rel=1e-8
        )

    def test_small_strains(self) -> None:
        strain = np.array([1e-14, 1e-8, 1e-6])
        np.testing.assert_allclose(
            master_curves.stick_slip(strain), 0.445096317 * np.sqrt(strain), rtol=1e-6
        )

    def test_triple_point(self) -> None:
        strain, friction = master_curves.stick_slip_triple_point()
        assert (strain, friction) == pytest.approx((0.3303, 0.3564), abs=5e-5)
        assert float(master_curves.stick_slip(strain)) == pytest.approx(friction, rel=1e-12)

    def test_inverse(self) -> None:
        strain = np.array([1e-10, 1e-3, 0.1, 0.33])
        np.testing.assert_allclose(
            master_curves.stick_slip_strain(master_curves.stick_slip(strain)), strain, rtol=1e-10
        )

    @pytest.mark.physics
    def test_grows(self) -> None:
        assert (np.diff(master_curves.stick_slip(np.geomspace(1e-6, 0.3302, 40))) > 0).all()

    def test_refined(self, monkeypatch: pytest.MonkeyPatch) -> None:
        strain = np.array([1e-6, 1e-2, 0.1, 0.33])
        fine = master_curves.stick_slip(strain)
        monkeypatch.setattr(boundary_values, "TOLERANCE", 1e-7)
        coarse = master_curves.stick_slip(strain)
        np.testing.assert_allclose(coarse, fine, rtol=1e-9)
        assert (coarse != fine).any()


def jacobi_fields(gamma: float, phi: float, poisson: float) -> tuple[Floats, Floats]:
    """Shoot from the free end: (eta, in-plane field) along the planar rod, from free end to clamp.

    Written in the arc length from the Kirchhoff equations of the design, not in the scaled form of
    master_curves.
    """
    C = 1 / (1 + poisson)

    def rate(x: float, y: Floats) -> Floats:  # x = 1 - s
        theta, m, mu0, mu1, eta, u, du = y
        along = [
            phi + m,
            gamma * x * np.sin(theta),
            phi * mu1,
            m * mu0 / C - (phi + m) * mu0 + gamma * x * eta,
            np.cos(theta) * mu1 + np.sin(theta) * mu0 / C,
        ]
        return np.array([*(-d for d in along), du, gamma * x * np.cos(theta) * u])

    def shoot(tip: float, rtol: float = 3e-14) -> Any:
        start = [tip, 0, 0, 0, 1, 1, 0]
        return solve_ivp(
            rate, (0, 1), start, method="DOP853", rtol=rtol, atol=3 * rtol, dense_output=True
        )

    # The branch from large weights: the angle at the free end is the least that brings the clamp
    # upright.
    ends = ((tip, shoot(tip, 1e-6).y[0, -1]) for tip in np.linspace(0.5, 5.0, 46))
    low, high = next((a[0], b[0]) for a, b in pairwise(ends) if a[1] < 0 < b[1])
    solution = shoot(brentq(lambda tip: shoot(tip).y[0, -1], low, high, xtol=1e-15, rtol=1e-15))
    x = np.linspace(0, 1, 401)
    return solution.sol(x)[4], solution.sol(x)[5]


@pytest.mark.physics
class TestBendTwist:
    @pytest.mark.parametrize(("phi", "poisson"), [(6.5, 0.0), (6.0, 0.3), (6.0, 0.5)])
    def test_definition(self, phi: float, poisson: float) -> None:
        """Jacobi's field out of the plane has its first zero at the clamp, the one in the plane
        none.
        """
        gamma = float(master_curves.bend_twist(phi, poisson))
        for change, sign in ((1e-8, 1), (-1e-8, -1)):
            eta, in_plane = jacobi_fields(gamma * (1 + change), phi, poisson)
            assert np.sign(eta[-1]) == sign
            assert (eta[:-1] > 0).all()
            assert (in_plane > 0).all()

    @pytest.mark.slow
    def test_long_rods_are_alike(self) -> None:
        """Gamma^(1/3) / phi tends to a constant of Poisson's ratio."""
        for poisson, constant in ((0.0, 0.516542), (0.3, 0.580823), (0.5, 0.620688)):
            gamma = master_curves.bend_twist([40.0, 25 * np.pi, 1000.0], poisson)
            scaled = np.cbrt(gamma) / [40.0, 25 * np.pi, 1000.0]
            np.testing.assert_allclose(scaled, constant, atol=1e-6)
            np.testing.assert_allclose(scaled, scaled[0], rtol=1e-10)

    @pytest.mark.slow
    def test_nothing_below_the_onset(self) -> None:
        phi, gamma = master_curves.bend_twist_onset(0.5)
        assert phi / np.pi == pytest.approx(1.767, abs=1e-3)
        values = master_curves.bend_twist([phi * (1 - 1e-9), phi * (1 + 1e-9), phi * 1.001], 0.5)
        assert np.isnan(values[0])
        assert values[1] == pytest.approx(gamma, rel=1e-3)
        assert values[2] > values[1] > gamma

    def test_stiffer_in_twist_is_planar_longer(self) -> None:
        onsets = [master_curves.bend_twist_onset(nu)[0] for nu in (0.0, 0.3, 0.5)]
        assert onsets[0] > onsets[1] > onsets[2]

    @pytest.mark.slow
    def test_independent_of_what_was_asked_before(self) -> None:
        bend_twist._boundary.cache_clear()
        first = master_curves.bend_twist(10.0, 0.4)
        bend_twist._boundary.cache_clear()
        master_curves.bend_twist([8.0, 12.0, 6.0], 0.4)
        assert first.tobytes() == master_curves.bend_twist(10.0, 0.4).tobytes()


@pytest.mark.slow
def test_shapes() -> None:
    assert master_curves.cantilever(1.0).shape == ()
    assert master_curves.cantilever(np.ones((2, 3))).shape == (2, 3)
    assert master_curves.cantilever([]).shape == (0,)
    assert master_curves.bend_twist([[8.0], [9.0]], 0.5).shape == (2, 1)
    assert master_curves.stick_slip([[0.1], [0.2]]).shape == (2, 1)
    assert master_curves.stick_slip_strain(0.2).shape == ()
    assert master_curves.lateral_buckling([0.5, 1.0], 0.3).shape == (2,)


class TestHeavyFold:
    @pytest.mark.physics
    @pytest.mark.parametrize("gap", [1e-4, 1.0 / 16.0, 0.3])
    def test_shape(self, gap: float) -> None:
        """The strip that starts with these forces ends as it lands, and is as high and wide."""
        fold = master_curves.heavy_fold(gap)
        V = fold.landing_force - fold.loop_length

        def rate(s: float, y: Floats) -> Floats:
            bend = -fold.tension * np.sin(y[0]) - (V + s) * np.cos(y[0])
            return np.array([y[1], bend, np.cos(y[0]), np.sin(y[0])])

        whole = np.linspace(0.0, fold.loop_length, 20_001)
        theta, kappa, x, y = solve_ivp(
            rate,
            (0.0, fold.loop_length),
            np.zeros(4),
            method="DOP853",
            t_eval=whole,
            rtol=1e-13,
            atol=1e-13,
        ).y
        assert (theta[-1], kappa[-1], y[-1]) == pytest.approx((np.pi, 0.0, gap), abs=1e-6)
        assert theta.max() > np.pi
        assert fold.tension == pytest.approx(0.5 * gap, abs=1e-8)
        assert fold.height == pytest.approx(y.max(), rel=1e-7)
        assert fold.nose_to_landing == pytest.approx(x.max() - x[-1], rel=1e-6)
        assert fold.pull(0.3, 2.0) == pytest.approx(
            0.3 * (2.0 + fold.landing_force) + 0.5 * gap, rel=1e-7
        )

    def test_arguments(self) -> None:
        with pytest.raises(ValueError, match=r"gap: must be in \(0, 0\.5\], got 0\.0"):
            master_curves.heavy_fold(0.0)


class TestCapstan:
    def test_without_bending_it_is_eulers(self) -> None:
        mu = np.array([0.0, 0.1, 0.8, 1.5])
        assert master_curves.capstan(mu, 2.0) == pytest.approx(np.exp(2.0 * mu), rel=1e-12)

    @pytest.mark.parametrize("bending", [0.01, 0.2])
    @pytest.mark.parametrize("mu", [0.1, 0.7])
    def test_tension_along_the_cylinder(self, mu: float, bending: float) -> None:
        """In the strip where it lies, T' = mu (T - B) and the pressure per width is (T - B) / R,
        from end to end.
        """
        light, wrap = 1.0, 2.5
        heavy = float(master_curves.capstan(mu, wrap, bending))
        begin, end = (np.arccos(1.0 - bending / tension) for tension in (light, heavy))
        on_cylinder = light + mu * np.sqrt(2.0 * light * bending - bending**2)
        lying = solve_ivp(
            lambda _, tension: mu * (tension - bending),
            (begin, wrap - end),
            [on_cylinder],
            rtol=1e-11,
            atol=1e-12,
        )
        leaving = float(lying.y[0, -1]) + mu * np.sqrt(2.0 * heavy * bending - bending**2)
        assert leaving == pytest.approx(heavy, rel=1e-9)

    def test_no_friction_no_difference(self) -> None:
        assert master_curves.capstan(0.0, 3.0, 0.1) == pytest.approx(1.0, abs=1e-12)

    def test_arguments(self) -> None:
        with pytest.raises(ValueError, match="mu: must be in"):
            master_curves.capstan(-0.1, 1.0)
        with pytest.raises(ValueError, match="bending: must be in"):
            master_curves.capstan(0.1, 1.0, 1.0)
        with pytest.raises(ValueError, match="wrap: must be above"):
            master_curves.capstan(0.1, 0.1, 0.5)


def test_no_solution() -> None:
    """y' = 1 + y^2 keeps y finite over less than pi only."""
    s = np.linspace(0, 4, 5)
    with np.errstate(all="ignore"), pytest.raises(master_curves.NotSolvedError):
        boundary_values.solve_boundary_values(
            lambda s, y: 1 + y**2, lambda first, last: first, s, np.zeros((1, 5))
        )


def test_arguments() -> None:
    with pytest.raises(ValueError, match=r"gamma: must be finite and > 0, got 0\.0"):
        master_curves.cantilever([1.0, 0.0])
    with pytest.raises(ValueError, match="phi: must be finite and > 0, got nan"):
        master_curves.bend_twist(np.nan, 0.5)
    with pytest.raises(ValueError, match="phi: must be real numbers"):
        master_curves.bend_twist(["six"], 0.5)
    with pytest.raises(ValueError, match=r"poisson: must be in \[0, 0\.5\], got 0\.6"):
        master_curves.bend_twist(6.0, 0.6)
    with pytest.raises(ValueError, match=r"aspect: must be in \[0\.01, 1\], got 1\.5"):
        master_curves.lateral_buckling([0.2, 1.5], 0.3)
    with pytest.raises(ValueError, match=r"strain: must be in \(0, 0\.33028543\d+\], got 0\.34"):
        master_curves.stick_slip(0.34)
    with pytest.raises(ValueError, match=r"friction: must be in \(0, 0\.35637002\d+\], got 0\.0"):
        master_curves.stick_slip_strain([0.1, 0.0])
    with pytest.raises(ValueError, match=r"strain: must be in .* got nan"):
        master_curves.stick_slip(np.nan)
