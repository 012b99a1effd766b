"""Distance to itself and reach of curves for which both are known.

Minima of rods known to have two.
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import RodSolution, other_minima, reach, self_contact_distance, solve_rods

Floats = NDArray[np.float64]


def helix(radius: float, pitch: float, turns: float, points: int = 400) -> Floats:
    a = 2 * np.pi * turns * np.linspace(0, 1, points)
    return np.stack([radius * np.cos(a), radius * np.sin(a), -pitch * a / (2 * np.pi)], axis=1)


def test_reach() -> None:
    np.testing.assert_allclose(reach(helix(0.1, 0.1, 3.0)[None]), 0.2, atol=1e-4)


def test_tight_helix_is_a_pitch_away_from_itself() -> None:
    """Neighbouring turns: nearly the pitch, seen along the slope of the turns."""
    radius, pitch = 0.1, 0.02
    expected = pitch * 2 * np.pi * radius / np.hypot(2 * np.pi * radius, pitch)
    # The chords of 400 points sag by 1e-4.
    np.testing.assert_allclose(
        self_contact_distance(helix(radius, pitch, 4.0)[None]), expected, rtol=5e-3
    )


def test_crossing_strands() -> None:
    """An overhand crossing whose strands pass each other at distance 0.03, between points."""
    t = np.linspace(-1, 1, 151)
    loop = np.stack([t**3 - 0.6 * t, t**2, 0.015 * t / np.sqrt(0.6)], axis=1)
    np.testing.assert_allclose(self_contact_distance(loop[None]), 0.03, rtol=1e-2)


def test_curves_that_stay_clear_of_themselves() -> None:
    straight = np.linspace(0, 1, 50)[:, None] * np.array([[0.0, 0.0, -1.0]])
    arc = helix(0.5, 0.0, 0.4)[::8]
    for curve in (straight, arc):
        assert self_contact_distance(curve[None])[0] == np.inf


def test_rods_without_a_solution_have_no_labels() -> None:
    nothing = np.full((1, 150, 3), np.nan)
    assert np.isnan(self_contact_distance(nothing)).all()
    assert np.isnan(reach(nothing)).all()


def test_thesis_rods_are_clear_of_themselves(solved: RodSolution) -> None:
    assert self_contact_distance(solved.centerline[:100]).min() > 0.02
    assert reach(solved.centerline).max() < 0.3


def test_bad_centerline() -> None:
    with pytest.raises(
        ValueError, match=r"centerline: must have shape \(any, any, 3\), got shape \(5, 3\)"
    ):
        reach(np.zeros((5, 3)))


class TestOtherMinima:
    def test_weak_twist_leaves_both_hands_stable(self) -> None:
        minima = other_minima([600.0, 600.0], [0.3, 10.0], [15.0, 15.0])
        np.testing.assert_array_equal(minima.multistable, [True, False])
        assert minima.energy[0] - solve_rods([600.0], [0.3], [15.0]).energy[0] > 0.1
        assert np.isfinite(minima.centerline[0]).all()
        assert np.isnan(minima.energy[1])
        assert np.isnan(minima.centerline[1]).all()

    def test_mirrored_family(self) -> None:
        """phi0 = 0 but for a hair: both hands have the same energy."""
        minima = other_minima([600.0], [1e-9], [15.0])
        assert minima.multistable[0]
        assert minima.energy[0] == pytest.approx(
            solve_rods([600.0], [1e-9], [15.0]).energy[0], abs=1e-4
        )

    def test_only_where_twist_is_weak(self, thesis_rods: Floats, solved: RodSolution) -> None:
        minima = other_minima(*thesis_rods.T, solution=solved)
        _, phi0, phi1 = thesis_rods[minima.multistable].T
        assert 10 < minima.multistable[:400].sum() < 40  # 4.7 % of 2,000 over the ranges
        assert phi0.max() < 4.2
        assert phi1.min() > 9.0
        assert (minima.energy[minima.multistable] > solved.energy[minima.multistable]).all()

    def test_bad_solution(self, solved: RodSolution) -> None:
        with pytest.raises(ValueError, match=r"solution: must be of 1 rods at 150 points"):
            other_minima([600.0], [0.3], [15.0], solution=solved)
