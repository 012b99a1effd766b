"""The collocation solver against problems with closed forms."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core.reference import boundary_value
from stickslip_sim_core.reference.boundary_value import NotSolvedError, Numbers, solve

Floats = NDArray[np.float64]


def test_gauss_method_integrates_polynomials() -> None:
    A, b, c = boundary_value.gauss_method()
    for power in range(boundary_value.STAGES):
        np.testing.assert_allclose(A @ c**power, c ** (power + 1) / (power + 1), atol=1e-15)
    for power in range(2 * boundary_value.STAGES):
        assert b @ c**power == pytest.approx(1 / (power + 1), abs=1e-15)


def test_nonlinear_problem() -> None:
    """y'' = 3/2 y^2, y(0) = 4, y(1) = 1: y = 4 / (1 + x)^2 [Stoer and Bulirsch 2002, Sec. 7.3]."""

    def rate(x: Floats, y: Numbers, p: Numbers) -> Numbers:
        return np.stack([y[1], 1.5 * y[0] ** 2])

    def conditions(first: Numbers, last: Numbers, p: Numbers) -> Numbers:
        return np.stack([first[0] - 4.0, last[0] - 1.0])

    mesh = np.linspace(0, 1, 9)
    found = solve(rate, conditions, mesh, np.stack([4 - 3 * mesh, -3 + 0 * mesh]))
    np.testing.assert_allclose(found.y[0], 4 / (1 + mesh) ** 2, rtol=1e-12)
    assert found.integral(lambda y: y[0]) == pytest.approx(2.0, rel=1e-12)


def test_unknown_parameter() -> None:
    """y'' = -p^2 y, y(0) = 0, y'(0) = 1, y(1) = 0: p = pi."""

    def rate(x: Floats, y: Numbers, p: Numbers) -> Numbers:
        return np.stack([y[1], -(p[0] ** 2) * y[0]])

    def conditions(first: Numbers, last: Numbers, p: Numbers) -> Numbers:
        return np.stack([first[0], first[1] - 1.0, last[0]])

    mesh = np.linspace(0, 1, 9)
    found = solve(rate, conditions, mesh, np.stack([mesh * (1 - mesh), 1 - 2 * mesh]), np.array([3.0]))
    assert found.parameters[0] == pytest.approx(np.pi, rel=1e-13)


def test_growth_no_shooting_would_survive() -> None:
    """y'' = 1e6 y with layers at both ends, which grow and decay by e^1000 across."""

    def rate(x: Floats, y: Numbers, p: Numbers) -> Numbers:
        return 1e3 * np.stack([y[1], y[0]])

    def conditions(first: Numbers, last: Numbers, p: Numbers) -> Numbers:
        return np.stack([first[0] - 1.0, last[0] - 2.0])

    half = np.concatenate([[0.0], np.geomspace(5e-4, 0.5, 16)])
    mesh = np.unique(np.concatenate([half, 1 - half]))
    found = solve(rate, conditions, mesh, np.zeros((2, len(mesh))))
    np.testing.assert_allclose(found.y[0], np.exp(-1e3 * mesh) + 2 * np.exp(-1e3 * (1 - mesh)), atol=1e-10)


def test_no_solution() -> None:
    """y'' = 1 + y'^2 keeps |y'| finite over less than pi only."""

    def rate(x: Floats, y: Numbers, p: Numbers) -> Numbers:
        return np.stack([1.0 + y[0] ** 2])

    def conditions(first: Numbers, last: Numbers, p: Numbers) -> Numbers:
        return np.stack([first[0]])

    with np.errstate(all="ignore"), pytest.raises(NotSolvedError):
        solve(rate, conditions, np.linspace(0, 4, 5), np.zeros((1, 5)))
