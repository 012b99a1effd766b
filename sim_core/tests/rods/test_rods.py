"""What solve_rods returns: accuracy, kinematics, symmetry, stability, and the minimum it finds."""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import RodSolution, _sim_core, solve_rods

Floats = NDArray[np.float64]

SADDLE = (100.0, 12.0)  # gamma, phi1 of a rod that leaves its plane


def largest_distance(a: Floats, b: Floats) -> Floats:
    """Largest distance between corresponding points of each rod, shape (n,)."""
    return np.asarray(np.linalg.norm(a - b, axis=2).max(axis=1))


class TestAccuracy:
    """Against the refined solve. Bounds are about twice what was measured on 4,000 rods."""

    def test_centerline(self, solved: RodSolution, refined: RodSolution) -> None:
        error = largest_distance(solved.centerline, refined.centerline)
        assert np.quantile(error, 0.95) <= 3e-7  # asked: 2e-6
        assert error.max() <= 3e-6

    def test_curvature(self, solved: RodSolution, refined: RodSolution) -> None:
        error = np.abs(solved.curvature - refined.curvature).max(axis=(1, 2))
        assert np.quantile(error / np.abs(refined.curvature).max(axis=(1, 2)), 0.95) <= 1.2e-5

    def test_frame(self, solved: RodSolution, refined: RodSolution) -> None:
        error = np.abs(solved.frame - refined.frame).max(axis=(1, 2, 3))
        assert np.quantile(error, 0.95) <= 5e-6

    def test_energy(self, solved: RodSolution, refined: RodSolution) -> None:
        assert np.abs(solved.energy - refined.energy).max() <= 1e-4

    def test_coarse_setting_for_a_thousandth(
        self, thesis_rods: Floats, refined: RodSolution
    ) -> None:
        coarse = solve_rods(*thesis_rods.T, elements=48)
        assert coarse.stable.all()
        assert largest_distance(coarse.centerline, refined.centerline).max() <= 1e-3

    def test_sixth_order(
        self, thesis_rods: Floats, solved: RodSolution, refined: RodSolution
    ) -> None:
        half = solve_rods(*thesis_rods.T, elements=64)
        for name in ("centerline", "curvature", "frame"):
            errors = [
                np.median(
                    np.abs(getattr(s, name) - getattr(refined, name))
                    .reshape(len(thesis_rods), -1)
                    .max(axis=1)
                )
                for s in (half, solved)
            ]
            assert np.log2(errors[0] / errors[1]) > 5.0, name

    def test_refinement_bounds_the_error_of_frames(
        self, solved: RodSolution, refined: RodSolution
    ) -> None:
        error = np.linalg.norm(solved.frame - refined.frame, axis=(2, 3)).max(axis=1) / np.sqrt(
            2
        )  # [rad]
        assert (error <= 0.5 * solved.refinement).all()


class TestMinimum:
    def test_all_stable(self, solved: RodSolution) -> None:
        assert solved.converged.all()
        assert solved.stable.all()

    def test_start_on_finer_levels_finds_the_same_minimum(
        self, thesis_rods: Floats, solved: RodSolution
    ) -> None:
        gamma, phi0, phi1 = np.ascontiguousarray(thesis_rods.T)
        for start_level in (1, 2):
            fine = RodSolution(
                *_sim_core.solve_rods(gamma, phi0, phi1, 1 / 1.5, 128, 150, start_level)
            )
            np.testing.assert_allclose(fine.centerline, solved.centerline, atol=1e-7)

    def test_planar_saddle_is_converged_but_not_stable(self) -> None:
        # phi0 = 0 keeps the search in the plane, where a long curl is a saddle [Romero et al. 2021,
        # Bend-Twist].
        planar = solve_rods([SADDLE[0]], [0.0], [SADDLE[1]])
        assert planar.converged.all()
        assert not planar.stable.any()
        np.testing.assert_allclose(planar.centerline[0, :, 1], 0.0, atol=1e-9)
        # Off the plane there is a lower minimum.
        twisted = solve_rods([SADDLE[0]], [1e-3], [SADDLE[1]])
        assert twisted.stable.all()
        assert twisted.energy[0] < planar.energy[0] - 0.1

    def test_hopelessly_coarse_rod_is_flagged(self) -> None:
        # Boundary layers of length gamma^-1/2 = 1e-4 on 12 elements.
        rod = solve_rods([1e8, 0.0], [0.0, 0.0], [5.0, 5.0], elements=12)
        assert not rod.converged[0]
        assert not rod.stable[0]
        assert np.isnan(rod.centerline[0]).all()
        assert np.isnan(rod.energy[0])
        assert rod.stable[1]
        assert np.isfinite(rod.frame[1]).all()


class TestKinematics:
    def test_frames_are_rotations(self, solved: RodSolution) -> None:
        R = solved.frame
        np.testing.assert_allclose(
            R.swapaxes(-1, -2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-14
        )
        np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)

    def test_clamp(self, solved: RodSolution) -> None:
        np.testing.assert_array_equal(solved.centerline[:, 0], 0.0)
        clamp = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])  # d1 = -z, d2 = x, d3 = -y
        np.testing.assert_allclose(
            solved.frame[:, 0], np.broadcast_to(clamp, (len(solved.frame), 3, 3)), atol=1e-15
        )

    def test_free_end_has_natural_curvature(self, thesis_rods: Floats, solved: RodSolution) -> None:
        np.testing.assert_allclose(solved.curvature[:, -1, 0], thesis_rods[:, 1], atol=1e-9)
        np.testing.assert_allclose(solved.curvature[:, -1, 1], 0.0, atol=1e-9)
        np.testing.assert_allclose(solved.curvature[:, -1, 2], thesis_rods[:, 2], atol=1e-9)

    def test_fields_derive_from_one_another(self, thesis_rods: Floats) -> None:
        """r' = d1 and R' = R [kappa]x, by fourth-order differences at 2,001 points."""
        rods = solve_rods(*thesis_rods[::20].T, points=2001)
        h = 1 / 2000

        def derivative(field: Floats) -> Floats:
            return (8 * (field[:, 3:-1] - field[:, 1:-3]) - (field[:, 4:] - field[:, :-4])) / (
                12 * h
            )

        inner = rods.frame[:, 2:-2]
        np.testing.assert_allclose(derivative(rods.centerline), inner[..., 0], atol=5e-6)
        kappa = rods.curvature[:, 2:-2]
        matrix = np.zeros_like(inner)
        matrix[..., 0, 1], matrix[..., 0, 2], matrix[..., 1, 2] = (
            -kappa[..., 2],
            kappa[..., 1],
            -kappa[..., 0],
        )
        matrix -= matrix.swapaxes(-1, -2)
        np.testing.assert_allclose(
            derivative(rods.frame), inner @ matrix, atol=5e-5 * np.abs(kappa).max()
        )

    @pytest.mark.parametrize("points", [2, 3, 65, 129, 150])
    def test_points_sample_one_curve(self, thesis_rods: Floats, points: int) -> None:
        few = solve_rods(*thesis_rods[:5].T, points=points)
        many = solve_rods(*thesis_rods[:5].T, points=4 * (points - 1) + 1)
        np.testing.assert_allclose(few.centerline, many.centerline[:, ::4], atol=1e-15)
        np.testing.assert_allclose(few.frame, many.frame[:, ::4], atol=1e-14)
        np.testing.assert_allclose(few.curvature, many.curvature[:, ::4], atol=1e-12)


class TestSymmetry:
    def test_mirror(self, thesis_rods: Floats, solved: RodSolution) -> None:
        """Turning the clamp by pi about z flips phi1; the mirror y -> -y flips phi0."""
        for sign0, sign1 in ((1, -1), (-1, 1), (-1, -1)):
            gamma, phi0, phi1 = thesis_rods[::10].T
            other = solve_rods(gamma, sign0 * phi0, sign1 * phi1)
            mirror = np.array([sign1, sign0 * sign1, 1.0])
            np.testing.assert_allclose(
                other.centerline, solved.centerline[::10] * mirror, atol=1e-8
            )
            np.testing.assert_allclose(other.energy, solved.energy[::10], atol=1e-8)
            signs = np.array([sign0, sign0 * sign1, sign1])
            np.testing.assert_allclose(other.curvature, solved.curvature[::10] * signs, atol=1e-6)

    def test_poisson_sets_twist_stiffness(self) -> None:
        """At a given pull, a rod that is stiffer in twist turns less from its natural twist."""
        soft, stiff = (solve_rods([500.0], [5.0], [10.0], poisson=p) for p in (0.5, -0.9))
        assert (
            np.abs(stiff.curvature[0, :, 0] - 5.0).max()
            < 0.5 * np.abs(soft.curvature[0, :, 0] - 5.0).max()
        )


def test_no_rods() -> None:
    nothing = solve_rods([], [], [])
    assert nothing.centerline.shape == (0, 150, 3)
    assert nothing.frame.shape == (0, 150, 3, 3)
    assert nothing.stable.shape == (0,)
