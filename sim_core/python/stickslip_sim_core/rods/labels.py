"""Labels of hanging rods: distance from themselves, sideways reach, and other stable equilibria."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.rods.solve import (
    ELEMENT_TURN_MAX,
    Bools,
    RodSolution,
    finite_array,
    solve_general_rods,
    solve_rods,
)


def reach(centerline: ArrayLike) -> Floats:
    """Return the largest distance of each rod from the vertical through its clamp: (n,) [L].

    The axis z points up. `centerline` has positions (n, points, 3) [L] from the clamp on. The
    distance of a rod with NaN positions is NaN.
    """
    r = _centerlines(centerline)
    return np.asarray(np.linalg.norm(r[..., :2] - r[:, :1, :2], axis=2).max(axis=1))


def self_contact_distance(centerline: ArrayLike) -> Floats:
    """Return the least distance of each centreline from another part of itself.

    Neighbouring parts are always close, so only local minima count. Such a minimum is a minimum of
    the distance between two points of the centreline that are free to slide along it, ends
    included. It is the doubly critical distance in the theory of ideal knots [Gonzalez and Maddocks
    1999]. A rod of radius r touches itself if this distance is below 2 r.

    `centerline` has positions (n, points, 3) [L], joined by straight segments. The distance (n,)
    [L] is infinite without such a minimum, for example on a straight rod. It is NaN for a rod with
    NaN positions.
    """
    r = _centerlines(centerline)
    return np.array([_self_contact_distance(rod) for rod in r]).reshape(len(r))


def _centerlines(centerline: ArrayLike) -> Floats:
    # Rods that did not converge are NaN throughout, which the check of the shape must let pass.
    r = np.asarray(centerline)
    finite_array("centerline", np.nan_to_num(r) if r.dtype.kind == "f" else r, (None, None, 3))
    if r.shape[1] < 2:
        raise ValueError(f"centerline: must have at least 2 points, got {r.shape[1]}")
    return np.asarray(r, dtype=np.float64)


def _self_contact_distance(r: Floats) -> float:
    """Return the self-contact distance of a single rod, shape (points, 3)."""
    if np.isnan(r).any():
        return np.nan
    p = len(r)
    squared = (r**2).sum(axis=1)
    distance2 = squared[:, None] + squared - 2.0 * (r @ r.T)
    # A pair of points is a local minimum if no neighbour of the pair, among eight, is closer.
    padded = np.full((p + 2, p + 2), np.inf)
    padded[1:-1, 1:-1] = distance2
    around = [
        padded[1 + i : p + 1 + i, 1 + j : p + 1 + j]
        for i, j in product((-1, 0, 1), repeat=2)
        if (i, j) != (0, 0)
    ]
    minimal = distance2 <= np.minimum.reduce(around)
    first, second = np.nonzero(np.triu(minimal, k=2))
    if first.size == 0:
        return np.inf
    # The minimum lies on one of the segments that meet at the two points.
    a, b = (np.stack([np.clip(x - 1, 0, p - 2), np.clip(x, 0, p - 2)]) for x in (first, second))
    i, j = (x.ravel() for x in np.broadcast_arrays(a[:, None], b[None, :]))
    # Segments with a common point touch without being a contact.
    apart = j - i >= 2
    return float(
        _segment_distance(r[i[apart]], r[i[apart] + 1], r[j[apart]], r[j[apart] + 1]).min(
            initial=np.inf
        )
    )


def _segment_distance(a0: Floats, a1: Floats, b0: Floats, b1: Floats) -> Floats:
    """Return distances between segments a0-a1 and b0-b1, (k, 3) each [Ericson 2004, Sec. 5.1.9]."""
    u = a1 - a0
    v = b1 - b0
    w = a0 - b0
    uu, uv, vv, uw, vw = ((x * y).sum(axis=1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    tiny = np.finfo(float).tiny
    # Parallel segments have no single closest pair, so any s will do.
    determinant = uu * vv - uv**2
    s = np.where(
        determinant > 1e-14 * uu * vv,
        np.clip((uv * vw - vv * uw) / np.maximum(determinant, tiny), 0, 1),
        0.0,
    )
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0.0, 1.0)
    return np.asarray(np.linalg.norm(w + s[:, None] * u - t[:, None] * v, axis=1))


DISTINCT = 1e-3
"""Largest distance of centrelines [L] at which two equilibria count as one.

It is 100 times the solver's error.
"""

MIRROR = np.array([-1.0, -1.0, 1.0])
"""Factors of (twist, bend about d2, bend about d3) under the mirror of world y."""


@dataclass(frozen=True, eq=False)
class OtherMinima:
    """Other stable equilibria of n rods."""

    multistable: Bools
    """Whether another stable equilibrium than that of `solve_rods` was found, shape (n,).

    False is no proof that no other exists.
    """

    energy: Floats
    """Energy of the other stable equilibrium [EI/L], shape (n,), or NaN."""

    centerline: Floats
    """Centreline of the other stable equilibrium [L], shape (n, points, 3), or NaN."""


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
    """Search for another stable equilibrium than `solve_rods` finds.

    `solve_rods` reaches its equilibrium from the natural shape. Rods can curl with either hand, so
    each rod starts again from the mirror image of its equilibrium. Equilibria whose centrelines
    differ by more than 1e-3 L are distinct.

    Over the thesis's ranges this start found every rod that 28 other starts found. Those starts
    were straight, weakly curled, twisted either way, of two hands, random, or continued in the
    weight.

    Args:
        gamma: As for `solve_rods`.
        phi0: As for `solve_rods`.
        phi1: As for `solve_rods`.
        poisson: As for `solve_rods`.
        elements: As for `solve_rods`.
        points: As for `solve_rods`.
        solution: Result of `solve_rods` for exactly these arguments. It saves solving again.

    Raises:
        ValueError: An argument breaks its rule. The message names the field, the rule and the
            value.
    """
    weight = finite_array("gamma", gamma, (None,))
    n = len(weight)
    twist = finite_array("phi0", phi0, (n,))
    bend = finite_array("phi1", phi1, (n,))
    options = {"elements": elements, "points": points}
    rods = (
        solve_rods(weight, twist, bend, poisson=poisson, **options)
        if solution is None
        else solution
    )
    if rods.centerline.shape != (n, points, 3):
        raise ValueError(
            f"solution: must be of {n} rods at {points} points, got shape {rods.centerline.shape}"
        )

    natural = np.stack([twist, np.zeros(n), bend], axis=1)[:, None, :]
    stiffness = (1.0 / (1.0 + poisson), 1.0, 1.0)
    # The curvature of the start is cut down to the limit of the coarsest level. Rods without an
    # equilibrium start straight.
    start = np.nan_to_num(rods.curvature * MIRROR)
    largest = np.linalg.norm(start, axis=2).max(axis=1, initial=0.0)
    limit = 0.9 * ELEMENT_TURN_MAX * (elements // 4)
    start = start * np.minimum(1.0, limit / np.maximum(largest, 1e-300))[:, None, None]
    other = solve_general_rods(
        natural, weight, stiffness=stiffness, start_curvature=start, **options
    )
    distance = np.linalg.norm(other.centerline - rods.centerline, axis=2).max(axis=1)
    # `not <=` is also true for the NaN of a rod that `solve_rods` did not solve.
    distinct = other.stable & ~(distance <= DISTINCT)
    centerline = np.where(distinct[:, None, None], other.centerline, np.nan)
    return OtherMinima(distinct, np.where(distinct, other.energy, np.nan), centerline)
