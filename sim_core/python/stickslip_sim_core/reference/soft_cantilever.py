"""Master curve of a strip whose rigidity falls with curvature, clamped horizontally."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference.boundary_values import NotSolvedError

RELATIVE = 1e-11
ABSOLUTE = 1e-13
"""Tolerances of the integration, with which the drop has nine digits."""

TIPS = 64
"""Number of angles of the tip between which the solution is looked for."""

STEEPEST = 0.5 * np.pi - 1e-9
"""Angle of the steepest of them: a heavy strip hangs nearly upright [rad]."""


def soft_cantilever(gamma: float, softening: float) -> float:
    """Return H/W of a heavy elastica that softens, clamped horizontally.

    H is the drop of its tip, W its horizontal reach. With the length as the unit, phi the angle of
    the tangent below the horizontal, t the distance from the free end, and M the moment over D/L,

        phi' = -k(M),   M' = gamma t cos phi,   phi(1) = 0,   M(0) = 0,
        M = (1 - k/k_s) k   up to k = k_s/2,   M = k/2   beyond.

    It is shot from the free end, over the angle of the tip there. Of several solutions it takes the
    one with the steepest tip, which hangs.

    Args:
        gamma: Weight against bending, rho A g L^3 / D [-], > 0.
        softening: Curvature of softening times the length, k_s L [-], > 0.

    Raises:
        NotSolvedError: No angle of the tip leaves the clamp horizontally.
    """
    tips = np.linspace(0.0, STEEPEST, TIPS)
    missed = [_clamp(tip, gamma, softening)[0] for tip in tips]
    for number in range(len(tips) - 1, 0, -1):
        if missed[number - 1] * missed[number] <= 0.0:
            tip = brentq(
                lambda angle: float(_clamp(angle, gamma, softening)[0]),
                tips[number - 1],
                tips[number],
                xtol=1e-13,
            )
            _, _, drop, reach = _clamp(tip, gamma, softening)
            return float(drop / reach)
    raise NotSolvedError(f"soft_cantilever: no solution at gamma = {gamma}, k_s L = {softening}")


def _clamp(tip: float, gamma: float, softening: float) -> Floats:
    """Return phi, M, drop and reach at the clamp for an angle of the tip."""
    largest = 0.25 * softening  # moment at which the law has its corner
    start = np.array([tip, 0.0, 0.0, 0.0])

    # The smaller root of M = (1 - k/k_s) k, in the form that does not cancel.
    def soft(moment: float) -> float:
        return 2.0 * moment / (1.0 + float(np.sqrt(max(1.0 - moment / largest, 0.0))))

    first = _integrated(soft, gamma, 0.0, start, corner=largest)
    if first.status == 0:
        return np.asarray(first.y[:, -1])
    # Beyond the corner the moment only grows towards the clamp.
    second = _integrated(lambda moment: 2.0 * moment, gamma, first.t[-1], first.y[:, -1])
    return np.asarray(second.y[:, -1])


def _integrated(
    curvature: Callable[[float], float],
    gamma: float,
    begin: float,
    start: Floats,
    corner: float = np.inf,
) -> Any:
    """Return the solution from a distance of the free end to the clamp, or up to a moment."""

    def change(t: float, y: Floats) -> list[float]:
        phi, moment, _, _ = y
        return [-curvature(moment), gamma * t * np.cos(phi), np.sin(phi), np.cos(phi)]

    def beyond(_t: float, y: Floats) -> float:
        return float(min(y[1] - corner, 1.0)) if np.isfinite(corner) else -1.0

    # The solver reads the attribute of the function.
    beyond.__dict__["terminal"] = True
    integrate: Any = solve_ivp
    return integrate(
        change, (begin, 1.0), start, method="DOP853", rtol=RELATIVE, atol=ABSOLUTE, events=beyond
    )
