"""The tilt of a clamp is fitted together with its rod."""

import numpy as np
import pytest

from stickslip_sim_core import fit_parameters, fit_tilted_clamp, solve_general_rods
from stickslip_sim_core.rods.solve import CLAMP_FRAME
from stickslip_sim_core.rods.tilt import tilted_frame

pytestmark = pytest.mark.physics

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
NOISE = 1e-3  # [L]


def test_a_tilt_turns_the_clamp_up() -> None:
    frame = tilted_frame(LEVEL, np.radians(30.0))
    np.testing.assert_allclose(frame[:, 0], [np.sqrt(0.75), 0.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("degrees", [-20.0, 0.0, 15.0])
@pytest.mark.parametrize(("gamma", "phi1"), [(60.0, -1.0), (400.0, 2.0)])
def test_the_tilt_and_the_rod_are_found(degrees: float, gamma: float, phi1: float) -> None:
    tilt = np.radians(degrees)
    rods = solve_general_rods(
        np.array([[[0.0, 0.0, phi1]]]),
        [gamma],
        clamp_frame=tilted_frame(LEVEL, tilt),
        points=101,
    )
    assert rods.stable[0]
    noise = NOISE * np.random.default_rng(4).normal(size=(101, 3))
    noise[0] = 0.0
    fit = fit_tilted_clamp(rods.centerline[0] + noise, phi0=0.0, clamp_frame=LEVEL)
    # Four standard errors: the tilt and the weight pull at the same points.
    assert abs(fit.tilt - tilt) < 4.0 * fit.tilt_error
    assert fit.tilt_error < np.radians(3.0)
    error = fit.rod.standard_error
    assert abs(fit.rod.gamma - gamma) < 4.0 * error[0]
    assert abs(fit.rod.phi1 - phi1) < 4.0 * error[2]
    assert fit.rod.residual == pytest.approx(NOISE, rel=0.15)


def test_a_level_clamp_that_is_not_level_biases_a_fit_without_tilt() -> None:
    rods = solve_general_rods(
        np.zeros((1, 1, 3)), [200.0], clamp_frame=tilted_frame(LEVEL, np.radians(-15.0)), points=101
    )
    centerline = rods.centerline[0]
    level = fit_parameters(centerline, phi0=0.0, clamp_frame=LEVEL)
    tilted = fit_tilted_clamp(centerline, phi0=0.0, clamp_frame=LEVEL)
    assert abs(level.gamma / 200.0 - 1.0) > 0.1
    assert tilted.rod.gamma == pytest.approx(200.0, rel=0.01)
    assert np.degrees(tilted.tilt) == pytest.approx(-15.0, abs=0.2)


def test_a_clamp_along_gravity_has_no_plane_to_tilt_in() -> None:
    rods = solve_general_rods(np.full((1, 1, 3), 5.0), [200.0], points=101)
    with pytest.raises(ValueError, match="clamp_frame: must not be along gravity"):
        fit_tilted_clamp(rods.centerline[0], clamp_frame=CLAMP_FRAME)
