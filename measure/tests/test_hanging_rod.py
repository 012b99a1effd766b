"""The hanging rod by shooting with SciPy from the clamp: it shares no code with stickslip.

    python measure/tests/test_hanging_rod.py > TABLE

writes the table that the experiment compares with.
"""

import json
import sys
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import root
from stickslip_measure.experiments import rods
from stickslip_sim_core.rods.solve import solve_general_rods

Floats = NDArray[np.float64]

POINTS = 65
"""Points of the table: all resolutions have every first, second or fourth of them."""

DIGITS = 12


def centreline(
    gamma: float, natural: tuple[float, float, float], stiffness: Floats, clamp: Floats
) -> Floats:
    """Return the centreline of a rod of length 1 at equally spaced points (POINTS, 3).

    With the frame R = (d1, d2, d3) and the moment m in world axes, in units of EI and the length,

        r' = d1,   R' = R [kappa]x,   kappa = kappa_natural + K^-1 R^T m,
        m' = -d1 x n,   n = -gamma (1 - s) e_z,   r(0) = 0, R(0) = clamp, m(1) = 0

    [Kirchhoff 1859; Love 1927, Sec. 254]. The weight grows from 0 in steps, each of which starts at
    the last solution.

    Args:
        gamma: Weight rho A g L^3 / EI.
        natural: Twist and curvatures about d2 and d3 without load, times the length.
        stiffness: GJ/EI, 1, 1: (3,).
        clamp: Columns d1, d2, d3 at the clamp: (3, 3).
    """

    places = np.linspace(0.0, 1.0, POINTS)

    def shot(moment: Floats, load: float) -> Floats:
        first = np.concatenate([np.zeros(3), clamp.ravel(), moment])
        change = partial(rates, gamma=load, natural=natural, stiffness=stiffness)
        run = solve_ivp(
            change, (0.0, 1.0), first, method="DOP853", t_eval=places, rtol=1e-12, atol=1e-13
        )
        return np.asarray(run.y)

    def free_moment(moment: Floats, load: float) -> Floats:
        return shot(moment, load)[12:, -1]

    moment = np.zeros(3)
    for share in np.linspace(0.0, 1.0, 11):
        # The free end has no moment.
        clamped = root(partial(free_moment, load=share * gamma), moment, tol=1e-12)
        if not clamped.success:
            raise RuntimeError(clamped.message)
        moment = clamped.x
    return shot(moment, gamma)[:3].T


def rates(
    s: float, y: Floats, gamma: float, natural: tuple[float, float, float], stiffness: Floats
) -> Floats:
    """Return the derivative of position, frame and moment: (15,)."""
    frame = y[3:12].reshape(3, 3)
    moment = y[12:]
    bent = np.einsum("ji,j->i", frame, moment) / stiffness
    twist, first, second = np.array(natural) + bent
    cross = np.array([[0.0, -second, first], [second, 0.0, -twist], [-first, twist, 0.0]])
    turning = -np.cross(frame[:, 0], [0.0, 0.0, -gamma * (1.0 - s)])
    return np.concatenate([frame[:, 0], (frame @ cross).ravel(), turning])


STIFFNESS = np.array([1.0 / (1.0 + rods.POISSON), 1.0, 1.0])


def test_the_table_is_what_scipy_finds() -> None:
    line = centreline(rods.GAMMA, rods.NATURAL, STIFFNESS, rods.CLAMP)
    np.testing.assert_allclose(rods.LENGTH * line, rods.reference(65), atol=1e-10)


def test_the_solver_of_stickslip_agrees_with_the_table() -> None:
    solved = solve_general_rods(
        np.array(rods.NATURAL)[None, None],
        [rods.GAMMA],
        stiffness=STIFFNESS,
        clamp_frame=rods.CLAMP,
        elements=512,
        points=17,
    )
    np.testing.assert_allclose(rods.LENGTH * solved.centerline[0], rods.reference(17), atol=1e-9)


def main() -> None:
    """Print the table of the experiment."""
    line = centreline(rods.GAMMA, rods.NATURAL, STIFFNESS, rods.CLAMP)
    json.dump([[round(float(x), DIGITS) for x in point] for point in line], sys.stdout)
    sys.stdout.write("\n")


if __name__ == "__main__":
    main()
