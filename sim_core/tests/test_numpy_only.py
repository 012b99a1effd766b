"""The package needs NumPy only; protocols and master curves need SciPy, which an extra brings."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.interpolate import BSpline, CubicHermiteSpline, PchipInterpolator, make_interp_spline
from scipy.spatial.transform import Rotation

from stickslip_sim_core import rotations, splines

RNG = np.random.default_rng(5)


@pytest.mark.parametrize("intervals", [1, 2, 7])
def test_b_splines(intervals: int) -> None:
    s = np.linspace(0.0, 1.0, 37)
    knots = np.arange(-3.0, intervals + 4.0) / intervals
    exact = BSpline.design_matrix(s, knots, 3, extrapolate=True).toarray()
    np.testing.assert_allclose(splines.bspline_matrix(intervals, s), exact, atol=1e-14)


@pytest.mark.parametrize("derivative", [0, 1])
@pytest.mark.parametrize("samples", [2, 3, 4, 5, 40])
def test_interpolating_splines(samples: int, derivative: int) -> None:
    places = np.linspace(0.0, 1.0, samples)
    s = np.linspace(0.0, 1.0, 53)
    spline = make_interp_spline(places, np.eye(samples), k=min(3, samples - 1))
    exact = spline.derivative(derivative)(s)
    matrix = splines.interpolation_matrix(samples, s, derivative)
    np.testing.assert_allclose(matrix, exact, atol=1e-12 * samples)


def test_monotone_cubics_through_keyframes() -> None:
    times = np.array([0.0, 0.3, 1.0, 1.1, 2.5])
    values = np.array([[0.0, 1.0], [1.0, 1.0], [0.5, 2.0], [0.5, 3.0], [4.0, 7.0]])
    inner = PchipInterpolator(times, values).derivative()(times[1:-1])
    np.testing.assert_allclose(splines.monotone_slopes(times, values), inner, rtol=1e-14)
    slopes = RNG.normal(size=values.shape)
    at = np.linspace(0.0, 2.5, 41).reshape(1, -1)
    exact = CubicHermiteSpline(times, values, slopes)(at)
    np.testing.assert_allclose(splines.hermite(times, values, slopes, at), exact, atol=1e-13)
    assert splines.hermite(times, values, slopes, np.array(0.3)) == pytest.approx(values[1])


def test_rotations() -> None:
    vectors = np.concatenate(
        [
            RNG.normal(size=(200, 3)),
            1e-5 * RNG.normal(size=(20, 3)),
            np.zeros((1, 3)),
            np.pi * np.eye(3),
        ]
    )
    turns = Rotation.from_rotvec(vectors)
    np.testing.assert_allclose(
        rotations.matrices_of_vectors(vectors), turns.as_matrix(), atol=1e-14
    )
    quaternions = np.roll(turns.as_quat(), 1, axis=1)
    np.testing.assert_allclose(
        rotations.matrices_of_quaternions(quaternions), turns.as_matrix(), atol=1e-14
    )
    back = rotations.quaternions_of_matrices(turns.as_matrix())
    # A quaternion and its negative are the same turn.
    sign = np.sign((back * quaternions).sum(axis=1))
    np.testing.assert_allclose(sign[:, None] * back, quaternions, atol=1e-14)
    assert rotations.quaternions_of_matrices(np.empty((0, 3, 3))).shape == (0, 4)


BARE = """
import sys
sys.modules["scipy"] = None  # an import of it fails
import numpy as np
import stickslip_sim_core as core
from stickslip_sim_core.scenes import cloth_drag
run = cloth_drag.scene("gray-interlock", 0.5, mesh=11).run()
rods = core.solve_rods([50.0], [1.0], [4.0])
core.fit_parameters(rods.centerline[0])
core.natural_curvature(rods.curvature, rods.frame, [50.0])
"""


@pytest.mark.physics
def test_a_drag_and_a_fit_need_no_scipy() -> None:
    subprocess.run([sys.executable, "-c", BARE], check=True, timeout=600)
