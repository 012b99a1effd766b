"""A rod that hangs in three dimensions: natural bend and twist against weight."""

from functools import lru_cache

import numpy as np
from stickslip_sim_core.rods.solve import CLAMP_FRAME, solve_general_rods

from stickslip_measure.contract import Floats, Rod
from stickslip_measure.laboratory import DOWN, GRAVITY, Experiment, Laboratory, Reading, settled

LENGTH = 0.5  # m
DENSITY = 0.01  # kg/m
GAMMA = 20.0
"""Weight rho A g L^3 / EI."""

NATURAL = (2.0, 0.0, 3.0)
"""Natural twist and curvatures times the length [rad]."""

POISSON = 0.5
REFERENCE = 512
"""Elements of the reference, whose error is 1e-8 (`stickslip certify --preset rods`)."""

DAMPING = 5.0  # 1/s
SETTLING = 20.0  # longest time of settling [s]


@lru_cache
def reference(points: int) -> Floats:
    """Return the centreline at equally spaced points (points, 3) [m]."""
    rods = solve_general_rods(
        np.array(NATURAL)[None, None],
        [GAMMA],
        stiffness=(1.0 / (1.0 + POISSON), 1.0, 1.0),
        elements=REFERENCE,
        points=points,
    )
    return np.asarray(LENGTH * rods.centerline[0])


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
        np.array(CLAMP_FRAME),
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
        "Kirchhoff's rod [Bertails et al. 2006], on 512 elements",
        "depth of the tip [m]",
        "",
        frozenset({"rods"}),
        (16, 32, 64),
        ("distance from the vertical [mm]", "height [mm]"),
        hanging_rod,
    ),
)
