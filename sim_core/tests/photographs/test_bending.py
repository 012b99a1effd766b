"""Bending lengths of threads in drawn photographs."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from stickslip_sim_core import solve_general_rods
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.photographs.bending import (
    LEVEL,
    View,
    correlation_length,
    joint_bending,
    measure_centerline,
    measure_thread,
)
from stickslip_sim_core.photographs.ruler import scale_of_marks, scale_of_points

LENGTH_MM = 150.0

Draw = Callable[..., Any]


@pytest.mark.parametrize(
    ("gamma", "bend", "roll"), [(40.0, 0.0, 0.0), (200.0, 3.0, 1.5), (1000.0, -2.0, -1.0)]
)
def test_gamma_of_a_photograph_is_within_five_percent(
    draw: Draw, gamma: float, bend: float, roll: float
) -> None:
    photograph = draw(gamma, bend, roll=roll, seed=int(gamma))
    scale = scale_of_marks(photograph.picture, 1.0)
    view = View(photograph.ledge, scale, roll=np.radians(roll), roll_error=np.radians(0.1))
    measured, _ = measure_thread(photograph.picture, view)
    gamma_seen = (measured.length / measured.bending_length) ** 3
    assert measured.length == pytest.approx(LENGTH_MM, rel=5e-3)
    assert gamma_seen == pytest.approx(gamma, rel=0.05)
    off = abs(measured.natural_bend - 1e3 * bend / LENGTH_MM)
    assert off < 3.0 * measured.natural_bend_error + 0.5
    assert measured.residual < 2e-3 * LENGTH_MM


def test_a_thread_to_the_left_is_measured_mirrored(draw: Draw) -> None:
    photograph = draw(200.0, 3.0, is_mirrored=True)
    scale = scale_of_points((0.0, 0.0), (400.0, 0.0), 100.0)
    measured, thread = measure_thread(photograph.picture, View(photograph.ledge, scale, side=-1))
    assert (measured.length / measured.bending_length) ** 3 == pytest.approx(200.0, rel=0.05)
    assert measured.natural_bend == pytest.approx(20.0, abs=1.5)
    assert thread.points[:, 0].max() <= photograph.ledge[0] + 2.0


def hung(gamma: float, length: float) -> Floats:
    """Return a straight rod from a level clamp: (401, 2) [mm]."""
    rod = solve_general_rods(
        np.zeros((1, 1, 3)), np.array([gamma]), clamp_frame=LEVEL, points=401
    ).centerline[0]
    return np.asarray(length * rod[:, [0, 2]])


def test_a_roll_of_the_camera_reads_as_stiffness_in_long_threads() -> None:
    # Both have a bending length of 20 mm; a degree of roll is noticed at once in the longer one.
    short = measure_centerline(hung(125.0, 100.0), 1.0, roll_error=np.radians(1.0))
    long = measure_centerline(hung(1953.125, 250.0), 1.0, roll_error=np.radians(1.0))
    for measured in (short, long):
        assert measured.bending_length == pytest.approx(20.0, rel=2e-3)
        assert abs(measured.change_at_ledge) < 0.05
    assert abs(long.change_by_roll) > 3.0 * abs(short.change_by_roll)
    assert long.bending_length_error >= abs(long.change_by_roll)
    joint = joint_bending([short, long])
    assert joint.bending_length == pytest.approx(20.0, rel=2e-3)
    assert joint.error < short.bending_length_error


def test_an_edge_that_bends_the_thread_widens_the_error() -> None:
    points = hung(125.0, 100.0)
    clean = measure_centerline(points, 3.0)
    # The first 3 mm lie on a rounded edge, 0.5 mm too high.
    points[points[:, 0] < 3.0, 1] += 0.5
    bent = measure_centerline(points, 3.0)
    assert abs(bent.change_at_ledge) > 10.0 * abs(clean.change_at_ledge)
    assert bent.bending_length_error >= abs(bent.change_at_ledge)


def test_scatter_beyond_the_errors_widens_the_joint_error() -> None:
    thread = measure_centerline(hung(125.0, 100.0), 1.0)
    alike = [replace(thread, bending_length=b, bending_length_error=5.0) for b in (18, 20, 22)]
    exact = [replace(bending, bending_length_error=0.1) for bending in alike]
    assert joint_bending(alike).error == pytest.approx(5.0 / np.sqrt(3.0))
    # The standard error of a mean of three values with a scatter of 2 mm.
    assert joint_bending(exact).error == pytest.approx(2.0 / np.sqrt(3.0))
    assert joint_bending(exact).scatter == pytest.approx(2.0)
    with pytest.raises(ValueError, match="two photographs or more, got 1"):
        joint_bending(alike[:1])


def test_white_noise_has_a_correlation_length_of_a_point() -> None:
    noise = np.random.default_rng(1).normal(size=(2001, 3))
    assert correlation_length(noise) == pytest.approx(1.0, abs=0.2)
    # A mean over five points correlates with 1 - k / 5 at a distance of k points.
    window = np.ones(5) / 5.0
    means = np.stack([np.convolve(column, window, mode="valid") for column in noise.T], axis=1)
    assert correlation_length(means) == pytest.approx(5.0, rel=0.2)
