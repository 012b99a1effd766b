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

    energy_gap: Floats
    """That energy less that of `solve_rods` [EI/L], shape (n,); negative where the other one is the lower."""

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
    thorough: bool = True,
) -> OtherMinima:
    """Search for stable equilibria other than the one that `solve_rods` reaches from the natural shape.

    What such rods have is a curl of either hand. Each rod therefore starts again from the mirror images of the
    equilibrium itself and of the one under a quarter of its weight, from its natural helix of the other hand, and with
    two turns of twist taken off. Over the thesis's ranges the first start alone found every rod that 28 others did,
    straight, weakly curled, twisted either way, of two hands, random, or continued in the weight. Equilibria whose
    centrelines differ by more than 1e-3 L are distinct.

    Args:
        gamma, phi0, phi1, poisson, elements, points: As for `solve_rods`.
        solution: What `solve_rods` returned for exactly these arguments, to save solving again.
        thorough: Try all starts; False: the first only, in a fifth of the time.

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
    starts = [found.curvature * MIRROR]
    if thorough:
        light = solve_rods(0.25 * weight, twist, bend, poisson=poisson, **options)
        untwisted = natural - np.copysign(4.0 * np.pi, natural) * [1.0, 0.0, 0.0]
        starts += [light.curvature * MIRROR, natural * MIRROR, untwisted]

    stiffness = (1.0 / (1.0 + poisson), 1.0, 1.0)
    energy = np.full(n, np.nan)
    centerline = np.full((n, points, 3), np.nan)
    for start in starts:
        start = _representable(start, elements)
        other = solve_general_rods(natural, weight, stiffness=stiffness, start_curvature=start, **options)
        distance = np.linalg.norm(other.centerline - found.centerline, axis=2).max(axis=1)
        better = other.stable & ~(distance <= DISTINCT) & ~(other.energy >= energy)
        energy[better], centerline[better] = other.energy[better], other.centerline[better]
    return OtherMinima(np.isfinite(energy), energy, energy - found.energy, centerline)


def _representable(start: Floats, elements: int) -> Floats:
    """Return the start with its curvature cut to what the coarsest level can hold, and 0 for rods without one."""
    start = np.nan_to_num(start)
    largest = np.linalg.norm(start, axis=2).max(axis=1, initial=0.0)
    limit = 0.9 * ELEMENT_TURN_MAX * (elements // 4)
    return np.asarray(start * np.minimum(1.0, limit / np.maximum(largest, 1e-300))[:, None, None])
