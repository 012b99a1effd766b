"""The chain's gradient and Hessian against finite differences of its energy and gradient."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stickslip_sim_core import _testing

Floats = NDArray[np.float64]

CLAMP = Rotation.from_matrix([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])


def chain(elements: int, turn: float, seed: int) -> Rotation:
    """Return clamped frames whose elements each turn by up to `turn` [rad]."""
    rng = np.random.default_rng(seed)
    frames = [CLAMP]
    for _ in range(elements):
        axis = rng.normal(size=3)
        frames.append(
            frames[-1] * Rotation.from_rotvec(axis / np.linalg.norm(axis) * rng.uniform(0.0, turn))
        )
    return Rotation.concatenate(frames)


def continuous_quaternions(frames: Rotation) -> Floats:
    """Rows (w, x, y, z) without jumps of sign, as the solver keeps them."""
    q = frames.as_quat(scalar_first=True)
    for i in range(1, len(q)):
        if q[i] @ q[i - 1] < 0:
            q[i] = -q[i]
    return np.asarray(q)


def derivatives(
    frames: Rotation, rod: tuple[float, float, float, float], omega: Floats
) -> tuple[float, Floats, Floats]:
    """Energy, gradient and Hessian with nodes 1 ... N turned by omega (3 N,), in world axes."""
    turns = Rotation.from_rotvec(np.concatenate([np.zeros((1, 3)), omega.reshape(-1, 3)]))
    gamma, phi0, phi1, C = rod
    return _testing.rod_derivatives(gamma, phi0, phi1, C, continuous_quaternions(turns * frames))


ROD = (700.0, 3.0, 12.0, 2.0 / 3.0)  # gamma, phi0, phi1, C


@pytest.mark.parametrize("turn", [1e-7, 0.3, 1.5, 3.0])
def test_gradient_is_derivative_of_energy(turn: float) -> None:
    frames = chain(6, turn, seed=1)
    _, gradient, _ = derivatives(frames, ROD, np.zeros(18))
    step = 1e-5
    differences = [
        (derivatives(frames, ROD, step * e)[0] - derivatives(frames, ROD, -step * e)[0])
        / (2 * step)
        for e in np.eye(18)
    ]
    # Rounding of energies of 1e3 over 2e-5, and step^2 times a third derivative.
    np.testing.assert_allclose(gradient, differences, atol=1e-6, rtol=1e-7)


@pytest.mark.parametrize("turn", [1e-7, 0.3, 1.5, 3.0])
def test_hessian_is_second_derivative_of_energy(turn: float) -> None:
    frames = chain(5, turn, seed=2)
    _, _, hessian = derivatives(frames, ROD, np.zeros(15))
    rng = np.random.default_rng(3)
    step = 1e-3
    for _ in range(30):
        # The exponential chart's own second derivative, along one direction: no commutators enter.
        d = rng.normal(size=15)
        values = [derivatives(frames, ROD, k * step * d)[0] for k in (-2, -1, 0, 1, 2)]
        second = np.dot([-1, 16, -30, 16, -1], values) / (12 * step**2)
        assert second == pytest.approx(d @ hessian @ d, abs=1e-5 * np.abs(hessian).max())


def test_hessian_is_symmetric_and_banded() -> None:
    _, _, hessian = derivatives(chain(6, 0.8, seed=4), ROD, np.zeros(18))
    np.testing.assert_array_equal(hessian, hessian.T)
    blocks = np.abs(hessian).reshape(6, 3, 6, 3).max(axis=(1, 3))
    i, j = np.indices(blocks.shape)
    assert (blocks[abs(i - j) > 1] == 0).all()
    assert (blocks[abs(i - j) <= 1] > 0).all()


def test_natural_shape_has_no_elastic_energy() -> None:
    n = 20
    natural = CLAMP * Rotation.from_rotvec(
        np.linspace(0, 1, n + 1)[:, None] * np.array([3.0, 0.0, 12.0])
    )
    energy, gradient, _ = _testing.rod_derivatives(
        0.0, 3.0, 12.0, 2.0 / 3.0, continuous_quaternions(natural)
    )
    assert energy == pytest.approx(0.0, abs=1e-26)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-12)


def test_weight_of_a_straight_rod() -> None:
    n = 10
    straight = np.tile([0.5, 0.5, 0.5, -0.5], (n + 1, 1))
    energy, _, _ = _testing.rod_derivatives(100.0, 0.0, 0.0, 1.0, straight)
    assert energy == pytest.approx(-50.0)  # gamma times the height -1/2 of its middle
