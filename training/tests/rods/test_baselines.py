import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline
from stickslip_training.rods.evaluation import (
    bending,
    cubic_spline_curvature,
    finite_difference_curvature,
    quintic_spline_curvature,
    relative_rms_error,
    rms,
    with_white_noise,
)

S = np.linspace(0.0, 1.0, 150)
METHODS = [finite_difference_curvature, cubic_spline_curvature, quintic_spline_curvature]


def circle(turns):
    """A circle of length 1 with several turns, in a tilted plane: |kappa| = 2 pi turns."""
    angle = 2 * np.pi * turns * S
    flat = np.stack([np.cos(angle), np.sin(angle), 0 * S], axis=-1) / (2 * np.pi * turns)
    tilt = np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]])
    return (flat @ tilt.T)[None]


def helix(radius, turns):
    """A helix of length 1: |kappa| = radius w^2 with w = 2 pi turns, the speed being 1."""
    w = 2 * np.pi * turns
    return np.stack(
        [radius * np.cos(w * S), radius * np.sin(w * S), np.sqrt(1 - (radius * w) ** 2) * S],
        axis=-1,
    )[None]


# Of order h^2 for differences, (2 pi)^2 h^2 / 4 here, most at the ends; cubic splines are wrong
# only at their ends, quintic ones by their most freedom, 0.7 n.
@pytest.mark.parametrize(
    ("method", "tolerance"), list(zip(METHODS, (2e-3, 2e-4, 2e-4), strict=True))
)
def test_a_circle(method, tolerance):
    curvature = method(circle(1.0))
    assert curvature.shape == (1, 150)
    assert np.abs(curvature[0, 15:-15] / (2 * np.pi) - 1).max() < tolerance


def test_a_cubic_spline_is_straight_at_its_ends_and_a_quintic_one_is_not():
    assert cubic_spline_curvature(circle(1.0))[0, [0, -1]].max() < 1e-6
    assert np.abs(quintic_spline_curvature(circle(1.0))[0, [0, -1]] / (2 * np.pi) - 1).max() < 0.1


@pytest.mark.parametrize("method", METHODS)
def test_a_helix(method):
    expected = 0.05 * (2 * np.pi * 2) ** 2
    assert np.abs(method(helix(0.05, 2.0))[0, 15:-15] / expected - 1).max() < 1e-2


def test_a_noisy_circle():
    """Errors of the kind that the literature and our own measurements give at 0.5 % noise."""
    noisy = with_white_noise(np.repeat(circle(2.0), 20, axis=0), 0.005, (1,))
    truth = np.full((20, 150), 4 * np.pi)
    error = {method: np.median(relative_rms_error(method(noisy), truth)) for method in METHODS}
    assert error[quintic_spline_curvature] < 0.15
    assert error[quintic_spline_curvature] < error[cubic_spline_curvature] < 0.35
    assert error[finite_difference_curvature] > 10


def test_the_cubic_spline_is_that_of_scipy():
    """Up to the choice of lambda, which scipy searches for and we take from a list."""
    noisy = with_white_noise(helix(0.05, 2.0), 0.003, (5,)).astype(np.float64)
    splines = [make_smoothing_spline(S, noisy[0, :, axis]) for axis in range(3)]
    first, second = (
        np.stack([spline(S, order) for spline in splines], axis=-1) for order in (1, 2)
    )
    expected = (
        np.linalg.norm(np.cross(first, second), axis=-1) / np.linalg.norm(first, axis=-1) ** 3
    )
    assert np.abs(cubic_spline_curvature(noisy)[0] - expected).max() < 0.03 * expected.max()


def test_every_rod_is_smoothed_by_itself():
    rods = with_white_noise(
        np.concatenate([circle(1.0), circle(3.0), helix(0.02, 3.0)]), 0.01, (0,)
    )
    together = quintic_spline_curvature(rods)
    for place in range(3):
        assert np.allclose(
            quintic_spline_curvature(rods[[place]])[0], together[place], rtol=1e-6, atol=1e-6
        )


def test_errors():
    strains = np.array([[[9.0, 3.0, -4.0], [9.0, 0.0, 5.0]]])
    assert np.array_equal(bending(strains), [[5.0, 5.0]])  # the twist is not in it
    assert relative_rms_error(np.array([[6.0, 4.0]]), bending(strains)) == pytest.approx([0.2])
    assert rms(np.array([[3.0, 4.0]])) == pytest.approx(np.sqrt(12.5))


def test_noise_is_of_the_given_share_and_the_seeds_own():
    rods = np.zeros((200, 150, 3), dtype=np.float32)
    noisy = with_white_noise(rods, 0.005, (0, 1))
    assert noisy.dtype == np.float32
    assert noisy.std() == pytest.approx(0.005, rel=0.01)
    assert np.array_equal(noisy, with_white_noise(rods, 0.005, (0, 1)))
    assert not np.array_equal(noisy, with_white_noise(rods, 0.005, (0, 2)))
    assert np.array_equal(with_white_noise(rods, 0.0, (0,)), rods)
