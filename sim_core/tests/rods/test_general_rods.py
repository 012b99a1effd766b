"""Rods beyond three numbers: against the uniform solver, closed forms, finer chains, and the
mechanics' symmetries.
"""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from stickslip_sim_core import RodSolution, _sim_core, solve_general_rods, solve_rods
from stickslip_sim_core.rods.solve import CLAMP_FRAME, clamp_quaternions
from stickslip_sim_core.splines import bspline_matrix, interpolation_matrix

Floats = NDArray[np.float64]

S = np.linspace(0, 1, 150)


def varying(n: int, seed: int) -> tuple[Floats, Floats]:
    """Natural curvature (n, 150, 3) that varies smoothly along the rod, and gamma (n,)."""
    rng = np.random.default_rng(seed)
    natural = rng.uniform([0.2, -3, 6], [12, 3, 20], (n, 3))[:, None] * np.ones((1, 150, 1))
    for k in (1, 2, 3):
        natural += rng.normal(size=(n, 1, 3)) * 2 / k * np.cos(np.pi * k * S)[:, None]
    return natural, rng.uniform(100, 1300, n)


def largest_distance(a: RodSolution, b: RodSolution) -> Floats:
    return np.asarray(np.linalg.norm(a.centerline - b.centerline, axis=2).max(axis=1))


@pytest.mark.parametrize("samples", [1, 2, 7, 150])
def test_constant_natural_curvature_is_the_uniform_rod(
    thesis_rods: Floats, solved: RodSolution, samples: int
) -> None:
    gamma, phi0, phi1 = thesis_rods.T
    natural = np.stack([phi0, 0 * phi0, phi1], axis=1)[:, None] * np.ones((1, samples, 1))
    general = solve_general_rods(natural, gamma)
    np.testing.assert_allclose(general.centerline, solved.centerline, atol=1e-12)
    np.testing.assert_allclose(general.curvature, solved.curvature, atol=1e-9)
    np.testing.assert_allclose(general.energy, solved.energy, atol=1e-9)
    np.testing.assert_array_equal(general.stable, solved.stable)


def test_twist_stiffness_is_poisson(thesis_rods: Floats) -> None:
    gamma, phi0, phi1 = thesis_rods[:20].T
    natural = np.stack([phi0, 0 * phi0, phi1], axis=1)[:, None]
    general = solve_general_rods(natural, gamma, stiffness=(1 / 1.2, 1, 1))
    assert largest_distance(general, solve_rods(gamma, phi0, phi1, poisson=0.2)).max() <= 1e-12


@pytest.mark.parametrize("anisotropic", [False, True])
@pytest.mark.parametrize("clamped", [False, True])
def test_accuracy(anisotropic: bool, clamped: bool) -> None:
    natural, gamma = varying(60, seed=3)
    K = np.random.default_rng(4).uniform(0.4, 1.5, (60, 3)) if anisotropic else (2 / 3, 1.0, 1.0)
    clamp = Rotation.random(60, random_state=1).as_matrix() if clamped else CLAMP_FRAME
    rods = solve_general_rods(natural, gamma, stiffness=K, clamp_frame=clamp)
    finer = solve_general_rods(natural, gamma, stiffness=K, clamp_frame=clamp, elements=512)
    assert rods.stable.all()
    np.testing.assert_allclose(rods.frame[:, 0], np.broadcast_to(clamp, (60, 3, 3)), atol=1e-14)
    # A clamp that points anywhere makes boundary layers; hanging ones come to 2e-7 at the 95th
    # percentile.
    error = largest_distance(rods, finer)
    assert np.quantile(error, 0.95) <= (6e-5 if clamped else 6e-7)


def test_without_weight_it_is_the_natural_shape() -> None:
    natural, _ = varying(3, seed=5)
    rods = solve_general_rods(natural, np.zeros(3), stiffness=(0.5, 0.7, 1.3))
    np.testing.assert_allclose(rods.curvature, natural, atol=1e-9)
    np.testing.assert_allclose(rods.energy, 0.0, atol=1e-9)


def test_stiffnesses_scale_against_the_weight() -> None:
    natural, gamma = varying(5, seed=6)
    K = np.array([0.5, 0.8, 1.2])
    single, two = (
        solve_general_rods(natural, gamma, stiffness=K),
        solve_general_rods(natural, 2 * gamma, stiffness=2 * K),
    )
    np.testing.assert_allclose(single.centerline, two.centerline, atol=1e-12)


def test_turn_about_the_vertical_turns_the_rod() -> None:
    natural, gamma = varying(5, seed=7)
    turn = Rotation.from_euler("z", 0.7).as_matrix()
    turned = solve_general_rods(natural, gamma, clamp_frame=turn @ CLAMP_FRAME)
    np.testing.assert_allclose(
        turned.centerline, solve_general_rods(natural, gamma).centerline @ turn.T, atol=1e-9
    )


def test_roll_of_the_frame_is_a_roll_of_stiffness_and_curvature() -> None:
    """A quarter turn of the material axes about the tangent swaps the bends."""
    natural, gamma = varying(5, seed=8)
    solution = solve_general_rods(natural, gamma, stiffness=(0.6, 0.8, 1.3))
    quarter = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # new d2 = d3, new d3 = -d2
    other = solve_general_rods(
        natural @ quarter, gamma, stiffness=(0.6, 1.3, 0.8), clamp_frame=CLAMP_FRAME @ quarter
    )
    np.testing.assert_allclose(other.centerline, solution.centerline, atol=1e-9)


def test_free_end_has_natural_curvature() -> None:
    natural, gamma = varying(5, seed=9)
    rods = solve_general_rods(natural, gamma, stiffness=(0.6, 0.8, 1.3))
    np.testing.assert_allclose(rods.curvature[:, -1], natural[:, -1], atol=1e-9)


def test_start_of_the_other_hand_finds_the_other_minimum() -> None:
    natural = np.array([[[0.3, 0.0, 15.0]]])
    solution = solve_general_rods(natural, [600.0])
    other = solve_general_rods(natural, [600.0], start_curvature=solution.curvature * [-1, -1, 1])
    assert other.stable.all()
    assert largest_distance(solution, other)[0] > 0.01
    assert other.energy[0] > solution.energy[0]


def test_every_kernel_gives_the_same_bits() -> None:
    natural, gamma = varying(11, seed=10)
    n, N, P = 11, 64, 20
    grid, nodes, points = (np.linspace(0, 1, k) for k in (2 * N + 1, N // 2 + 1, P))
    on_grid, slope = (
        interpolation_matrix(150, grid) @ natural,
        interpolation_matrix(150, nodes, 1) @ natural,
    )
    at_points = interpolation_matrix(150, points) @ natural
    clamp = np.ascontiguousarray(np.broadcast_to([0.5, 0.5, 0.5, -0.5], (n, 4)))
    K = np.ascontiguousarray(np.broadcast_to([0.5, 0.8, 1.2], (n, 3)))
    results = [
        _sim_core.solve_general_rods(
            gamma, K, clamp, on_grid, on_grid, slope, at_points, N, 30.0, kernel=kernel
        )
        for kernel in _sim_core.kernels()
    ]
    for result in results[1:]:
        for a, b in zip(results[0], result, strict=True):
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def test_quaternions_of_clamps() -> None:
    R = Rotation.random(200, random_state=2)
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3))
    for rotations in (R, half_turns):
        q = clamp_quaternions(rotations.as_matrix(), len(rotations))
        back = Rotation.from_quat(q, scalar_first=True).as_matrix()
        np.testing.assert_allclose(back, rotations.as_matrix(), atol=1e-14)


@pytest.mark.parametrize("samples", [4, 5, 9, 60])
@pytest.mark.parametrize("derivative", [0, 1])
def test_spline_is_scipys(samples: int, derivative: int) -> None:
    values, s = np.random.default_rng(samples).normal(size=samples), np.linspace(0, 1, 77)
    expected = CubicSpline(np.linspace(0, 1, samples), values)(s, derivative)
    np.testing.assert_allclose(
        interpolation_matrix(samples, s, derivative) @ values, expected, atol=1e-9
    )


def test_splines_add_up_to_one() -> None:
    np.testing.assert_allclose(bspline_matrix(7, S).sum(axis=1), 1.0)


def test_no_rods() -> None:
    assert solve_general_rods(np.empty((0, 1, 3)), []).frame.shape == (0, 150, 3, 3)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        (
            "natural_curvature",
            [[1.0, 2.0, 3.0]],
            r"natural_curvature: must have shape \(any, any, 3\), got shape \(1, 3\)",
        ),
        (
            "natural_curvature",
            np.empty((1, 0, 3)),
            r"natural_curvature: must have at least one sample",
        ),
        ("gamma", [1.0, 2.0], r"gamma: must have shape \(1\), got shape \(2,\)"),
        ("gamma", [-1.0], r"gamma: must be >= 0, got -1.0"),
        ("stiffness", (1.0, 0.0, 1.0), r"stiffness: must be > 0, got 0.0"),
        ("stiffness", (1.0, 1.0), r"stiffness: must have shape \(1, 3\), got shape \(2,\)"),
        ("clamp_frame", -np.eye(3), r"clamp_frame: must be a rotation, got .* det -1"),
        (
            "clamp_frame",
            2 * np.eye(3),
            r"clamp_frame: must be a rotation, got R\^T R - 1 = 3.0e\+00",
        ),
        (
            "start_curvature",
            [[[np.nan, 0, 0]]],
            r"start_curvature: must be finite, got nan at index 0, 0, 0",
        ),
        ("elements", 50, r"elements: must be a multiple of 4"),
        (
            "start_curvature",
            [[[0, 0, 500.0]]],
            r"elements: must be at least .* \|natural curvature\| = 500",
        ),
    ],
)
def test_bad_argument(field: str, value: object, message: str) -> None:
    arguments = {"natural_curvature": [[[1.0, 0.0, 6.0]]], "gamma": [100.0], field: value}
    with pytest.raises(ValueError, match=message):
        solve_general_rods(**arguments)  # type: ignore[arg-type]
