"""Fits of rods in any clamp: level ones, leaning ones, and centrelines of another clamp."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import fit_natural_curvature, fit_parameters, solve_general_rods, solve_rods
from stickslip_sim_core.rods.clamp import MAX_ANGLE, leaving_direction, refuse_other_clamp
from stickslip_sim_core.rods.solve import CLAMP_FRAME

pytestmark = pytest.mark.physics

Floats = NDArray[np.float64]

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""A rod over the edge of a table: d1 along x, and d3 across the plane of x and z."""

NOISE = 1e-3  # [L]


def level_rods(count: int, phi0_max: float, seed: int) -> tuple[Floats, Floats]:
    """Return parameters (count, 3) of rods in a level clamp, and noisy centrelines of them."""
    rng = np.random.default_rng(seed)
    gamma = np.exp(rng.uniform(np.log(20.0), np.log(2000.0), count))
    phi0 = rng.uniform(0.0, phi0_max, count)
    phi1 = rng.uniform(-10.0, 10.0, count)
    natural = np.stack([phi0, 0.0 * phi0, phi1], axis=1)
    rods = solve_general_rods(natural[:, None], gamma, clamp_frame=LEVEL, points=101)
    # Some rods that bend upwards in a plane are unstable, and fall over to a side.
    stable = rods.stable
    exact = rods.centerline[stable]
    parameters = np.stack([gamma, phi0, phi1], axis=1)[stable]
    return parameters, exact + NOISE * rng.normal(size=exact.shape)


class TestLevelClamp:
    def test_plane_rods(self) -> None:
        """gamma within 5 %, and the stated errors of gamma and of the bend hold."""
        truth, noisy = level_rods(40, phi0_max=0.0, seed=11)
        fits = [fit_parameters(r, phi0=0.0, clamp_frame=LEVEL) for r in noisy]
        gamma = np.array([fit.gamma for fit in fits])
        assert np.abs(gamma / truth[:, 0] - 1.0).max() < 0.05
        estimated = np.array([(fit.gamma, fit.phi1) for fit in fits])
        error = np.array([fit.standard_error[[0, 2]] for fit in fits])
        within_two = np.abs(estimated - truth[:, [0, 2]]) < 2.0 * error
        assert within_two.mean() > 0.85  # 95 % are expected
        assert all(fit.phi0 == 0.0 and fit.standard_error[1] == 0.0 for fit in fits)

    def test_rods_of_unknown_twist(self) -> None:
        truth, noisy = level_rods(20, phi0_max=12.0, seed=12)
        fits = [fit_parameters(r, clamp_frame=LEVEL) for r in noisy]
        gamma = np.array([fit.gamma for fit in fits])
        assert np.abs(gamma / truth[:, 0] - 1.0).max() < 0.05

    def test_natural_curvature(self) -> None:
        truth, noisy = level_rods(6, phi0_max=0.0, seed=13)
        for (gamma, _, phi1), centerline in zip(truth, noisy, strict=True):
            fit = fit_natural_curvature(centerline, gamma=gamma, noise=NOISE, clamp_frame=LEVEL)
            size = np.hypot(fit.natural_curvature[:, 1], fit.natural_curvature[:, 2])
            assert np.sqrt(((size - abs(phi1)) ** 2).mean()) < 0.1 * abs(phi1) + 0.2
            # The hung rod leaves the clamp of the data, not the one along gravity.
            assert fit.solution.frame[0, 0] == pytest.approx(LEVEL, abs=1e-6)

    def test_bend_and_weight_that_look_alike(self) -> None:
        """A stiff rod sags by so little that a bend does the same, and the fit reports it."""
        stiff, soft = (
            solve_general_rods(
                np.array([[[0.0, 0.0, 0.5]]]), np.array([gamma]), clamp_frame=LEVEL, points=101
            ).centerline[0]
            for gamma in (0.2, 300.0)
        )
        noise = 5.0 * NOISE * np.random.default_rng(1).normal(size=stiff.shape)
        assert fit_parameters(stiff + noise, phi0=0.0, clamp_frame=LEVEL).trades_bend_for_weight
        assert not fit_parameters(soft + noise, phi0=0.0, clamp_frame=LEVEL).trades_bend_for_weight


class TestOtherClamp:
    @pytest.mark.parametrize("fit", [fit_parameters, fit_natural_curvature])
    def test_is_refused_with_both_directions(self, fit: object) -> None:
        _, noisy = level_rods(3, phi0_max=0.0, seed=14)
        for centerline in noisy:
            with pytest.raises(
                ValueError,
                match=r"centerline: must leave the clamp within 45 degrees of its d1, which points "
                r"90 degrees below the horizon, and leaves it \d+ degrees (above|below) the "
                r"horizon.*give the clamp_frame",
            ):
                fit(centerline)  # type: ignore[operator]

    def test_hanging_rod_in_a_level_clamp(self, thesis_rods: Floats) -> None:
        hanging = solve_rods(*thesis_rods[:20].T, points=101).centerline
        for centerline in hanging:
            with pytest.raises(ValueError, match="which points 0 degrees below the horizon"):
                fit_parameters(centerline, clamp_frame=LEVEL)

    @pytest.mark.parametrize("points", [8, 20, 150])
    def test_no_rod_of_its_own_clamp_is_refused(self, thesis_rods: Floats, points: int) -> None:
        """Also of curly rods with much noise, and with few points."""
        rng = np.random.default_rng(15)
        hanging = solve_rods(*thesis_rods.T, points=points).centerline
        for centerline in hanging[np.isfinite(hanging).all(axis=(1, 2))]:
            refuse_other_clamp(centerline + 0.005 * rng.normal(size=(points, 3)), CLAMP_FRAME)

    def test_direction_is_that_of_the_clamp(self) -> None:
        """Heavy rods bend over so near to the clamp that their first points show 25 degrees."""
        _, noisy = level_rods(20, phi0_max=12.0, seed=16)
        for centerline in noisy:
            direction, uncertainty = leaving_direction(centerline)
            angle = np.arccos(np.clip(direction @ LEVEL[:, 0], -1.0, 1.0))
            assert angle < np.radians(30.0)
            assert uncertainty < MAX_ANGLE / 3

    def test_points_that_do_not_leave_the_clamp(self) -> None:
        with pytest.raises(ValueError, match="centerline: must leave its first point"):
            fit_parameters(np.zeros((20, 3)))


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("phi0", np.inf, "phi0: must be finite, got inf"),
        ("clamp_frame", -np.eye(3), "clamp_frame: must be a rotation"),
        ("clamp_frame", np.eye(3)[None], r"clamp_frame: must have shape \(3, 3\)"),
    ],
)
def test_bad_argument(option: str, value: object, message: str) -> None:
    centerline = np.linspace(0.0, 1.0, 20)[:, None] * [1.0, 0.0, 0.0]
    with pytest.raises(ValueError, match=message):
        fit_parameters(centerline, **{option: value})  # type: ignore[arg-type]
