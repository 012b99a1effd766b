"""Coulomb's law of a pair: its branches, its roots, and the derivative of the branch at hand."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import _sim_core as core

Floats = NDArray[np.float64]

K, KAPPA = 3.0, 40.0
OPEN, SLIP, STICK = 0, 1, 2


def frame(seed: int) -> tuple[Floats, Floats, Floats]:
    """A normal and two directions across it."""
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return q[0], q[1], q[2]


def law(gap: float, n: Floats, slip: Floats, force: Floats, mu: float) -> tuple[int, Floats, Floats, Floats, float]:
    found: tuple[int, Floats, Floats, Floats, float] = core.pair_law(gap, n, slip, force, mu, K, KAPPA)
    return found


@pytest.mark.parametrize("seed", range(3))
def test_roots(seed: int) -> None:
    n, t, _ = frame(seed)
    zero = np.zeros(3)
    roots = [
        (OPEN, 0.1, zero, zero),
        (STICK, 0.0, zero, 2.0 * n + 0.9 * t),
        (SLIP, 0.0, -0.3 * t, 2.0 * n + 1.0 * t),
    ]
    for mode, gap, slip, force in roots:
        found = law(gap, n, slip, force, 0.5)
        assert found[0] == mode
        assert found[3] == pytest.approx(zero, abs=1e-12)  # nothing to correct
        assert found[4] == pytest.approx(0.0, abs=1e-24)


@pytest.mark.parametrize(
    ("gap", "slip", "force", "error"),
    [
        (0.1, 0.0, (0.0, 0.2), 0.2**2),  # a pull at a distance
        (-0.1, 0.0, (0.0, 0.0), (K * 0.1) ** 2),  # sinks in
        (0.0, 0.0, (2.0, 1.5), 0.5**2),  # beyond the cone
        (0.0, 0.1, (2.0, 0.0), (K * 0.1) ** 2),  # slips without friction
        (0.0, -1.0, (2.0, -1.0), 2.0**2),  # friction along the slip: 1 against -1
    ],
)
def test_error_is_the_force_by_which_the_law_is_missed(
    gap: float, slip: float, force: tuple[float, float], error: float
) -> None:
    n, t, _ = frame(1)
    assert law(gap, n, slip * t, force[0] * n + force[1] * t, 0.5)[4] == pytest.approx(error)


def test_a_pair_without_a_force_sticks_as_far_as_it_sinks_in() -> None:
    """At no force it would be frictionless, and cloth would slide away."""
    n, t, _ = frame(2)
    assert law(-0.1, n, 0.04 * t, np.zeros(3), 0.5)[0] == STICK
    mode, stiffness, _, _, _ = law(-0.1, n, 0.06 * t, np.zeros(3), 0.5)
    assert mode == SLIP
    assert stiffness @ n == pytest.approx(KAPPA * (n - 0.5 * t))  # with friction against the slip
    assert law(-0.1, n, 0.04 * t, np.zeros(3), 0.0)[0] == SLIP


def test_without_friction_it_never_sticks() -> None:
    n, _, _ = frame(3)
    mode, stiffness, _, force, _ = law(-0.1, n, np.zeros(3), 2.0 * n, 0.0)
    assert mode == SLIP
    assert stiffness == pytest.approx(KAPPA * np.outer(n, n))
    assert force == pytest.approx(KAPPA * 0.1 * n)


def test_sticking_row() -> None:
    n, t, s = frame(4)
    gap, slip = -0.01, 0.02 * t - 0.01 * s
    mode, stiffness, symmetric, force, _ = law(gap, n, slip, 2.0 * n, 0.5)
    assert mode == STICK
    assert stiffness == pytest.approx(KAPPA * np.eye(3))
    assert symmetric == pytest.approx(stiffness)
    assert force == pytest.approx(-KAPPA * (gap * n + slip))


@pytest.mark.parametrize("seed", range(5))
def test_slipping_row_is_newtons(seed: int) -> None:
    """dr = force - stiffness v solves the linearised law r_T = mu r_N tau/|tau|, by finite differences."""
    rng = np.random.default_rng(seed)
    n, t, s = frame(seed)
    mu, gap = 0.4, -0.01
    force = 2.0 * n + 0.3 * t + 0.5 * s
    slip = -0.9 * t + 0.4 * s
    across = np.stack([t, s])

    def missed(r: Floats, u: Floats) -> Floats:
        tau = across @ (r - K * u)
        return across @ r - mu * (r @ n) * tau / np.linalg.norm(tau)

    mode, stiffness, symmetric, rhs, _ = law(gap, n, slip, force, mu)
    assert mode == SLIP
    v = 0.01 * rng.normal(size=3)
    dr = rhs - stiffness @ v
    assert dr @ n == pytest.approx(-KAPPA * (gap + v @ n))  # the proximal row
    step = 1e-6
    derivative = np.zeros(2)
    for direction, of_force in ((dr, True), (v - (v @ n) * n, False)):
        plus = missed(force + step * direction * of_force, slip + step * direction * (not of_force))
        minus = missed(force - step * direction * of_force, slip - step * direction * (not of_force))
        derivative += (plus - minus) / (2.0 * step)
    assert missed(force, slip) + derivative == pytest.approx(np.zeros(2), abs=1e-8)
    assert symmetric == pytest.approx(symmetric.T)
    unsymmetric = stiffness - symmetric
    assert np.linalg.matrix_rank(unsymmetric) == 1
    assert unsymmetric @ n == pytest.approx(
        mu * KAPPA * (across @ (force - K * slip)) @ across / np.linalg.norm(across @ (force - K * slip))
    )
