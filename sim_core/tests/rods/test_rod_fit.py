"""Fits to centrelines: exact derivatives, exact data, noise, rods outside the family, bad
arguments.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import (
    RodSolution,
    _sim_core,
    fit_natural_curvature,
    fit_parameters,
    solve_general_rods,
    solve_rods,
)
from stickslip_sim_core.rods.hung_rod import HungRod, HungRodModel, parameters_of
from stickslip_sim_core.splines import bspline_matrix

pytestmark = pytest.mark.physics

Floats = NDArray[np.float64]

S = np.linspace(0, 1, 150)
NOISE = 0.005  # [L]


def bending_error(kappa: Floats, truth: Floats) -> float:
    """Relative root mean square error of the curvature of the centreline."""
    estimate, exact = np.hypot(kappa[:, 1], kappa[:, 2]), np.hypot(truth[:, 1], truth[:, 2])
    return float(np.sqrt(((estimate - exact) ** 2).mean() / (exact**2).mean()))


def noisy(rods: RodSolution, seed: int = 0) -> Floats:
    return rods.centerline + NOISE * np.random.default_rng(seed).normal(size=rods.centerline.shape)


@pytest.fixture(scope="module")
def outside() -> tuple[Floats, Floats, RodSolution]:
    """Natural curvature (6, 150, 3) outside the family, gamma (6,), and the rods."""
    rng = np.random.default_rng(3)
    natural = rng.uniform([0.2, 0, 6], [12, 0, 20], (6, 3))[:, None] * np.ones((1, 150, 1))
    for k in (1, 2, 3):
        natural += (
            rng.normal(size=(6, 1, 3))
            * np.array([2.0, 2.0, 3.0])
            / k
            * np.cos(np.pi * k * S)[:, None]
        )
    gamma = rng.uniform(100, 1300, 6)
    return natural, gamma, solve_general_rods(natural, gamma)


class TestModel:
    STIFFNESS = (0.6, 0.8, 1.3)

    def hung(self, points: int) -> tuple[HungRodModel, HungRod, RodSolution]:
        model = HungRodModel.of(points, self.STIFFNESS, intervals=5)
        rng = np.random.default_rng(1)
        coefficients = np.array([4.0, 0.5, 11.0]) + rng.normal(size=(8, 3))
        natural = bspline_matrix(5, S) @ coefficients
        rods = solve_general_rods(natural[None], [600.0], stiffness=self.STIFFNESS, points=points)
        full = solve_general_rods(natural[None], [600.0], stiffness=self.STIFFNESS)
        state = model.hang(600.0, coefficients, full.curvature[0])
        assert state is not None
        return model, state, rods

    @pytest.mark.parametrize("points", [9, 40, 150])
    def test_hangs_as_the_solver_says(self, points: int) -> None:
        _, state, rods = self.hung(points)
        np.testing.assert_allclose(state.centerline, rods.centerline[0], atol=1e-6)

    @pytest.mark.parametrize("points", [9, 150])
    def test_jacobian_is_the_derivative(self, points: int) -> None:
        """Every column by fourth-order differences of the whole forward solve."""
        model, state, _ = self.hung(points)
        jacobian = model.jacobian(state)
        step = 1e-4
        for column in range(len(parameters_of(state))):
            direction = np.zeros(len(parameters_of(state)))
            direction[column] = step
            moved = [model.moved(state, k * direction) for k in (-2, -1, 1, 2)]
            values = [m.centerline.ravel() for m in moved if m is not None]
            difference = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * step)
            np.testing.assert_allclose(jacobian[:, column], difference, atol=2e-9)

    def test_core_refuses_rows_that_disagree(self) -> None:
        clamp, natural = np.array([[0.5, 0.5, 0.5, -0.5]]), np.zeros((4, 3))
        with pytest.raises(ValueError, match=r"quaternions: must have 5 rows, got 1"):
            _sim_core.relax_chain(1.0, np.ones(3), natural, clamp)
        with pytest.raises(ValueError, match=r"basis: must have 4 rows, got 3"):
            _sim_core.chain_jacobian(
                1.0, np.ones(3), natural, np.tile(clamp, (5, 1)), np.ones((3, 1)), 1
            )

    def test_a_step_out_of_reach_is_no_state(self) -> None:
        model, state, _ = self.hung(20)
        assert model.moved(state, np.array([2.0, *np.zeros(24)])) is None


class TestParameters:
    def test_exact_data(self) -> None:
        for gamma, phi0, phi1 in ((150.0, 3.0, 8.0), (1300.0, 12.0, 20.0), (700.0, 0.3, 14.0)):
            fit = fit_parameters(solve_rods([gamma], [phi0], [phi1]).centerline[0])
            assert (fit.gamma, fit.phi0, fit.phi1) == pytest.approx((gamma, phi0, phi1), rel=1e-4)
            assert fit.residual < 1e-6

    def test_noise(self, thesis_rods: Floats, solved: RodSolution) -> None:
        fits = [fit_parameters(r) for r in noisy(solved)[:40]]
        errors = [
            bending_error(f.solution.curvature[0], k)
            for f, k in zip(fits, solved.curvature[:40], strict=True)
        ]
        assert np.median(errors) < 0.015  # 0.5 % over 50 rods; an earlier study's: 1.1 %
        parameters = np.array([(f.gamma, f.phi0, f.phi1) for f in fits])
        pulls = (parameters - thesis_rods[:40]) / np.array([f.standard_error for f in fits])
        assert 0.6 < np.sqrt((pulls**2).mean()) < 1.5

    def test_known_weight(self, thesis_rods: Floats, solved: RodSolution) -> None:
        gamma, phi0, phi1 = thesis_rods[0]
        fit = fit_parameters(noisy(solved)[0], gamma=gamma)
        assert fit.gamma == pytest.approx(gamma)
        assert fit.standard_error[0] == 0.0
        assert (fit.phi0, fit.phi1) == pytest.approx((phi0, phi1), rel=0.05)


class TestNaturalCurvature:
    @pytest.mark.slow
    def test_round_trip_outside_the_family(
        self, outside: tuple[Floats, Floats, RodSolution]
    ) -> None:
        """Noisy centreline, fit, hung again: to the true centreline and curvature."""
        natural, gamma, rods = outside
        fits = [fit_natural_curvature(r, gamma=g) for r, g in zip(noisy(rods), gamma, strict=True)]
        for fit, truth in zip(fits, rods.centerline, strict=True):
            assert np.linalg.norm(fit.solution.centerline[0] - truth, axis=1).max() < 2.5 * NOISE
            assert fit.noise == pytest.approx(NOISE, rel=0.1)
            assert fit.solution.stable.all()
        hanging = [
            bending_error(f.solution.curvature[0], k)
            for f, k in zip(fits, rods.curvature, strict=True)
        ]
        rest = [bending_error(f.natural_curvature, k) for f, k in zip(fits, natural, strict=True)]
        assert np.median(hanging) < 0.06
        assert np.median(rest) < 0.06
        uniform = [fit_parameters(r, gamma=g) for r, g in zip(noisy(rods), gamma, strict=True)]
        coarse = [
            bending_error(f.solution.curvature[0], k)
            for f, k in zip(uniform, rods.curvature, strict=True)
        ]
        assert np.median(hanging) < 0.5 * np.median(coarse)

    def test_in_the_family_it_is_the_uniform_rod(
        self, thesis_rods: Floats, solved: RodSolution
    ) -> None:
        errors = [
            bending_error(fit_natural_curvature(r, gamma=g).solution.curvature[0], k)
            for r, g, k in zip(
                noisy(solved)[:5], thesis_rods[:5, 0], solved.curvature[:5], strict=True
            )
        ]
        assert np.median(errors) < 0.02

    def test_known_noise_sets_the_residual(
        self, outside: tuple[Floats, Floats, RodSolution]
    ) -> None:
        _, gamma, rods = outside
        fit = fit_natural_curvature(noisy(rods)[0], gamma=gamma[0], noise=NOISE)
        assert fit.noise == pytest.approx(NOISE, rel=0.1)

    def test_unknown_weight(self, thesis_rods: Floats, solved: RodSolution) -> None:
        fit = fit_natural_curvature(noisy(solved)[0])
        assert fit.gamma == pytest.approx(thesis_rods[0, 0], rel=0.3)
        assert fit.residual == pytest.approx(NOISE, rel=0.1)

    def test_other_stiffness(self) -> None:
        """Rolling the clamp is rolling the natural curvature: what is fitted hangs alike."""
        natural = np.array([[[4.0, 3.0, 9.0]]])
        rods = solve_general_rods(natural, [400.0], stiffness=(0.9, 1.0, 1.0))
        fit = fit_natural_curvature(
            rods.centerline[0], gamma=400.0, stiffness=(0.9, 1.0, 1.0), noise=1e-4
        )
        np.testing.assert_allclose(
            fit.natural_curvature, np.broadcast_to(natural[0], (150, 3)), atol=0.05
        )


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("centerline", np.zeros((5, 3)), r"centerline: must have at least 8 points, got 5"),
        (
            "centerline",
            np.zeros((20, 2)),
            r"centerline: must have shape \(any, 3\), got shape \(20, 2\)",
        ),
        ("gamma", 0.0, r"gamma: must be > 0, got 0.0"),
        ("noise", 0.0, r"noise: must be > 0, got 0.0"),
        ("stiffness", (1.0, 1.0), r"stiffness: must have shape"),
    ],
)
def test_bad_argument(option: str, value: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit_natural_curvature(**{"centerline": np.zeros((20, 3)), option: value})  # type: ignore[arg-type]
