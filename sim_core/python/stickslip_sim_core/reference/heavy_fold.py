"""Master curve of a strip that is folded onto itself and lies under its own weight."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference.boundary_values import (
    NotSolvedError,
    solve_boundary_values,
    within,
)


@dataclass(frozen=True)
class HeavyFold:
    """A fold at rest, in units of the gravito-bending length L_gb = (D / (rho g))^(1/3)."""

    height: float
    """Height of the highest point over the layer below."""

    loop_length: float
    """Length of the strip between its lift-off and its landing."""

    nose_to_landing: float
    """Horizontal distance between the nose of the loop and the landing."""

    landing_force: float
    """Force of the layer below on the strip at the landing, over rho g L_gb."""

    tension: float
    """Tension of the strip at the landing, over rho g L_gb.

    It holds the upper layer back besides friction.
    """

    def pull(self, mu: ArrayLike, tail: ArrayLike) -> Floats:
        """Return the force over rho g L_gb, away from the loop, at which the upper layer slips.

        The force is horizontal. Friction bears mu (weight of the tail + landing force), and the
        tension of the loop holds the layer back.

        Args:
            mu: Friction of the strip with itself.
            tail: Length of the strip beyond the landing, over L_gb.
        """
        return np.asarray(mu) * (np.asarray(tail) + self.landing_force) + self.tension


@lru_cache
def heavy_fold(gap: float) -> HeavyFold:
    """Return the shape of a strip that is folded onto itself on a floor under its own weight.

    The strip lifts off at s = 0, and lands on the layer below at the height `gap`. With the angle
    theta of its tangent, kappa = theta', and the force (H, V + s) in the strip,

        kappa' = H sin(theta) - (V + s) cos(theta),   x' = cos(theta),   y' = sin(theta),
        theta = kappa = y = 0 at s = 0,   theta = pi, kappa = 0, y = gap at the end.

    kappa^2/2 + n . t - y is constant, so H = -gap/2. Friction thus changes nothing.

    Args:
        gap: Height of the upper layer over the lower layer at the landing, over L_gb, in (0, 0.5].

    Raises:
        ValueError: The gap breaks its rule.
    """
    within("gap", gap, 0.0, 0.5, open_below=True)

    def change(s: Floats, y: Floats, p: Floats) -> Floats:
        (theta, kappa, _, _) = y
        (H, V, length) = p
        bend = H * np.sin(theta) - (V + s * length) * np.cos(theta)
        return np.asarray(length * np.stack([kappa, bend, np.cos(theta), np.sin(theta)]))

    def ends(first: Floats, last: Floats, _: Floats) -> Floats:
        return np.array([*first, last[0] - np.pi, last[1], last[3] - gap])

    # A guess by eye, which rises to 1.3 pi and comes back.
    s = np.linspace(0.0, 1.0, 101)
    theta = np.where(
        s < 0.5, np.pi * 1.3 * np.sin(np.pi * s) ** 2, np.pi * (1.0 + 0.3 * np.sin(np.pi * s) ** 2)
    )
    x, y = (0.05 * np.cumsum(rate(theta)) for rate in (np.cos, np.sin))
    solution = solve_boundary_values(
        change,
        ends,
        s,
        np.stack([theta, np.gradient(theta, 0.05), x, y]),
        np.array([0.0, -3.0, 5.0]),
    )

    # The tangent is upright at the nose, and level again at the top.
    H, V, length = solution.p
    nose, top = (
        solution.sol(
            brentq(
                lambda s, angle=angle: solution.sol(s)[0] - angle,
                0.0,
                solution.x[solution.y[0].argmax()],
            )
        )
        for angle in (np.pi / 2.0, np.pi)
    )
    # The equations have other solutions, which are no folds.
    if not (solution.y[0].max() > np.pi and length > 0.0 and V < 0.0):
        raise NotSolvedError(f"heavy_fold: the solution at gap = {gap} is not the fold")
    return HeavyFold(
        height=float(top[3]),
        loop_length=float(length),
        nose_to_landing=float(nose[2] - solution.y[2, -1]),
        landing_force=float(V + length),
        tension=-float(H),
    )
