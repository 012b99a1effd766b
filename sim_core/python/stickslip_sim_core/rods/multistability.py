"""Other stable equilibria of suspended rods: which rods have more than one, and at what energy."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.general import ELEMENT_TURN_MAX, solve_general_rods
from stickslip_sim_core.rods.solve import RodSolution, finite_array, solve_rods

Bools = NDArray[np.bool_]

DISTINCT = 1e-3
"""Largest centreline distance [L] at which two equilibria count as one: 100 times the solver's error."""


MIRROR = np.array([-1.0, -1.0, 1.0])
"""What the mirror of world y does to (twist, bend about d2, bend about d3)."""


@dataclass(frozen=True, eq=False)
class OtherMinima:
    """Other stable equilibria of n rods."""

    multistable: Bools
    """A stable equilibrium other than that of `solve_rods` was found, shape (n,). False is no proof that none is."""

    energy: Floats
    """Lowest energy of another stable equilibrium [EI/L], shape (n,); NaN where none was found."""

    centerline: Floats
    """Centreline of that equilibrium [L], shape (n, points, 3); NaN where none was found."""


def other_minima(
    gamma: ArrayLike,
    phi0: ArrayLike,
    phi1: ArrayLike,
    *,
    poisson: float = 0.5,
    elements: int = 128,
    points: int = 150,
    solution: RodSolution | None = None,
) -> OtherMinima:
    """Search for a stable equilibrium other than the one that `solve_rods` reaches from the natural shape.

    What such rods have is a curl of either hand. Each rod therefore starts again from the mirror image of its
    equilibrium. Over the thesis's ranges this start found every rod that 28 others did, straight, weakly curled,
    twisted either way, of two hands, random, or continued in the weight. Equilibria whose centrelines differ by more
    than 1e-3 L are distinct.

    Args:
        gamma, phi0, phi1, poisson, elements, points: As for `solve_rods`.
        solution: What `solve_rods` returned for exactly these arguments, to save solving again.

    Raises:
        ValueError: An argument breaks its rule; the message names the field, the rule and the value.
    """
    weight = finite_array("gamma", gamma, (None,))
    n = len(weight)
    twist, bend = finite_array("phi0", phi0, (n,)), finite_array("phi1", phi1, (n,))
    options = {"elements": elements, "points": points}
    found = solve_rods(weight, twist, bend, poisson=poisson, **options) if solution is None else solution
    if found.centerline.shape != (n, points, 3):
        raise ValueError(f"solution: must be of {n} rods at {points} points, got shape {found.centerline.shape}")

    natural = np.stack([twist, np.zeros(n), bend], axis=1)[:, None, :]
    stiffness = (1.0 / (1.0 + poisson), 1.0, 1.0)
    start = _representable(found.curvature * MIRROR, elements)
    other = solve_general_rods(natural, weight, stiffness=stiffness, start_curvature=start, **options)
    distance = np.linalg.norm(other.centerline - found.centerline, axis=2).max(axis=1)
    distinct = other.stable & ~(distance <= DISTINCT)
    centerline = np.where(distinct[:, None, None], other.centerline, np.nan)
    return OtherMinima(distinct, np.where(distinct, other.energy, np.nan), centerline)


def _representable(start: Floats, elements: int) -> Floats:
    """Return the start with its curvature cut to what the coarsest level can hold, and 0 for rods without one."""
    start = np.nan_to_num(start)
    largest = np.linalg.norm(start, axis=2).max(axis=1, initial=0.0)
    limit = 0.9 * ELEMENT_TURN_MAX * (elements // 4)
    return np.asarray(start * np.minimum(1.0, limit / np.maximum(largest, 1e-300))[:, None, None])
