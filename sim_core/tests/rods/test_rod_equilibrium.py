"""The rods against results from other methods: closed forms, scipy's boundary value solver, the
inverse.
"""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_bvp, solve_ivp
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from stickslip_sim_core import RodSolution, solve_rods

Floats = NDArray[np.float64]

STIFFNESS = np.array([2 / 3, 1.0, 1.0])  # K at poisson = 0.5


def moment_rate(s: Floats, m: Floats, kappa: Floats, g: Floats, gamma: float) -> Floats:
    """m' = m x kappa - gamma (1 - s) e_x x g, shape (..., 3)."""
    tangent_cross_g = np.cross([1.0, 0.0, 0.0], g)
    return np.asarray(np.cross(m, kappa) - gamma * (1 - s)[..., None] * tangent_cross_g)


@pytest.mark.parametrize(
    ("phi0", "phi1"), [(3.0, 12.0), (12.0, 20.0), (-2.0, 6.0), (0.0, 9.0), (7.0, 0.0)]
)
def test_without_weight_it_is_the_helix(phi0: float, phi1: float) -> None:
    rod = solve_rods([0.0], [phi0], [phi1])
    s = np.linspace(0, 1, 150)[:, None]
    rate = np.hypot(phi0, phi1)
    axis = np.array([phi0, 0.0, phi1]) / rate
    e_x = np.array([1.0, 0.0, 0.0])
    clamp = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    # Integral of Rodrigues' formula.
    along = axis * axis[0]
    body = (
        s * along
        + np.sin(rate * s) / rate * (e_x - along)
        + (1 - np.cos(rate * s)) / rate * np.cross(axis, e_x)
    )
    np.testing.assert_allclose(rod.centerline[0], body @ clamp.T, atol=1e-8)
    frames = clamp @ Rotation.from_rotvec(rate * s * axis).as_matrix()
    np.testing.assert_allclose(rod.frame[0], frames, atol=1e-8)
    np.testing.assert_allclose(rod.curvature[0], np.tile([phi0, 0.0, phi1], (150, 1)), atol=1e-11)
    assert rod.energy[0] == pytest.approx(0.0, abs=1e-20)
    assert rod.stable[0]


@pytest.mark.parametrize("gamma", [0.0, 1.0, 1300.0, 1e6])
def test_straight_rod_hangs_straight(gamma: float) -> None:
    rod = solve_rods([gamma], [0.0], [0.0])
    s = np.linspace(0, 1, 150)
    np.testing.assert_allclose(rod.centerline[0], np.stack([0 * s, 0 * s, -s], axis=1), atol=1e-14)
    assert rod.energy[0] == pytest.approx(-gamma / 2)
    assert rod.stable[0]


@pytest.mark.parametrize(
    ("gamma", "phi0", "phi1"),
    [
        (100.0, 0.2, 6.0),
        (400.0, 3.0, 12.0),
        (1300.0, 12.0, 20.0),
        (1300.0, 0.2, 20.0),
        (20.0, 0.0, 3.0),
    ],
)
@pytest.mark.physics
def test_strong_form_by_collocation(gamma: float, phi0: float, phi1: float) -> None:
    """scipy's solve_bvp on the Kirchhoff equations in the material frame, 6 unknowns (m, g)."""
    natural = np.array([phi0, 0.0, phi1])

    def rate(s: Floats, y: Floats) -> Floats:
        m, g = y[:3].T, y[3:].T
        kappa = natural + m / STIFFNESS
        return np.concatenate([moment_rate(s, m, kappa, g, gamma).T, np.cross(g, kappa).T])

    def ends(a: Floats, b: Floats) -> Floats:
        return np.concatenate([a[3:] - [1.0, 0.0, 0.0], b[:3]])

    rod = solve_rods([gamma], [phi0], [phi1], points=201)
    s = np.linspace(0, 1, 201)
    start = np.concatenate([((rod.curvature[0] - natural) * STIFFNESS).T, -rod.frame[0, :, 2, :].T])
    solution = solve_bvp(rate, ends, s, start + 1e-3, tol=1e-9, max_nodes=100_000)
    assert solution.success
    m, g = solution.sol(s)[:3].T, solution.sol(s)[3:].T
    scale = np.abs(rod.curvature).max()
    np.testing.assert_allclose(rod.curvature[0], natural + m / STIFFNESS, atol=2e-5 * scale)
    np.testing.assert_allclose(-rod.frame[0, :, 2, :], g, atol=2e-5)


@pytest.mark.parametrize(("gamma", "tolerance"), [(100.0, 1e-4), (500.0, 1e-3), (1300.0, 3e-2)])
def test_inverse_recovers_the_natural_curvature(gamma: float, tolerance: float) -> None:
    """Eq. 5.1 backwards from m(1) = 0 [Bertails-Descoubes et al. 2018].

    It is ill-conditioned for large gamma.
    """
    phi0, phi1 = 4.0, 11.0
    rod = solve_rods([gamma], [phi0], [phi1], points=1201)
    s = np.linspace(0, 1, 1201)
    kappa, g = CubicSpline(s, rod.curvature[0]), CubicSpline(s, -rod.frame[0, :, 2, :])

    def rate(at: float, m: Floats) -> Floats:
        return moment_rate(np.array(at), m, kappa(at), g(at), gamma)

    m = solve_ivp(rate, (1.0, 0.0), np.zeros(3), t_eval=s[::-1], rtol=1e-10, atol=1e-11).y.T[::-1]
    natural = rod.curvature[0] - m / STIFFNESS
    np.testing.assert_allclose(natural, np.tile([phi0, 0.0, phi1], (1201, 1)), atol=tolerance)


def test_energy_is_the_integral(thesis_rods: Floats) -> None:
    """E = int 1/2 (kappa - kappa_bar)^T K (kappa - kappa_bar) + gamma z ds, by Boole's rule on the
    output.
    """
    gamma, phi0, phi1 = thesis_rods[::10].T
    rods = solve_rods(gamma, phi0, phi1, points=1201)
    natural = np.stack([phi0, 0 * phi0, phi1], axis=1)[:, None]
    density = (
        0.5 * ((rods.curvature - natural) ** 2 * STIFFNESS).sum(axis=2)
        + gamma[:, None] * rods.centerline[..., 2]
    )
    weights = np.tile([14.0, 32.0, 12.0, 32.0], 300)
    weights = np.append(weights, 7.0)
    weights[0] = 7.0
    np.testing.assert_allclose(
        density @ weights * (2 / 45 / 1200), rods.energy, atol=1e-3, rtol=1e-6
    )


def test_lowest_point_is_below_the_clamp(solved: RodSolution) -> None:
    """The rod never rises above its clamp over the thesis's ranges."""
    assert solved.centerline[..., 2].max() <= 1e-12
