"""A rod that hangs in three dimensions: natural bend and twist against weight."""

import json
from functools import lru_cache
from pathlib import Path

import numpy as np

from stickslip_measure.contract import Floats, Rod
from stickslip_measure.laboratory import DOWN, GRAVITY, Experiment, Laboratory, Reading, settled

LENGTH = 0.5  # m
DENSITY = 0.01  # kg/m
GAMMA = 20.0
"""Weight rho A g L^3 / EI."""

NATURAL = (2.0, 0.0, 3.0)
"""Natural twist and curvatures times the length [rad]."""

POISSON = 0.5
CLAMP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""Columns d1, along gravity, d2 and d3 of the frame at the clamp."""

TABLE = Path(__file__).with_name("hanging_rod.json")
"""The exact centreline of a rod of length 1, at 65 points.

measure/tests/test_hanging_rod.py solves the boundary value problem with SciPy to 1e-10.
"""

DAMPING = 5.0  # 1/s
SETTLING = 20.0  # longest time of settling [s]


@lru_cache
def reference(points: int) -> Floats:
    """Return the centreline at equally spaced points (points, 3) [m].

    Raises:
        ValueError: The table has no such points.
    """
    table = np.array(json.loads(TABLE.read_text(encoding="utf-8")))
    every, rest = divmod(len(table) - 1, points - 1)
    if rest:
        raise ValueError(f"points: must be 1 more than a divisor of {len(table) - 1}, got {points}")
    return LENGTH * table[::every]


def hanging_rod(laboratory: Laboratory, elements: int) -> Reading:
    """Measure the depth of a rod's tip, and the distance of its centreline from the reference."""
    bending = DENSITY * GRAVITY * LENGTH**3 / GAMMA
    twist, first, second = (number / LENGTH for number in NATURAL)
    scene = Rod(
        LENGTH,
        elements,
        DENSITY,
        bending * laboratory.softer,
        bending * laboratory.softer / (1.0 + POISSON),
        (twist, first, second),
        CLAMP,
    )
    simulation = laboratory.open(scene)
    simulation.settle_gently(DAMPING)
    still = settled(simulation, DOWN, LENGTH, SETTLING)
    exact = reference(elements + 1)
    distance = float(np.linalg.norm(still - exact, axis=1).max())
    return Reading(
        float(-still[-1, 2]),
        float(-exact[-1, 2]),
        1e3 * np.linalg.norm(exact[:, :2], axis=1),
        1e3 * still[:, 2],
        1e3 * exact[:, 2],
        {"largest distance over the length": distance / LENGTH},
    )


EXPERIMENTS = (
    Experiment(
        "hanging-rod",
        "A curly rod hangs in three dimensions",
        "Kirchhoff's rod [Kirchhoff 1859], as a boundary value problem",
        "depth of the tip [m]",
        "",
        frozenset({"rods"}),
        (16, 32, 64),
        ("distance from the vertical [mm]", "height [mm]"),
        hanging_rod,
    ),
)
