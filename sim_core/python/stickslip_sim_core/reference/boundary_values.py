"""Boundary value problems of the master curves, and the rules of their arguments.

Every curve of a rod, or of a strip that bends in one direction, comes from the differential
equations of the continuous rod. scipy's collocation solves them to `TOLERANCE`.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_bvp

from stickslip_sim_core.arrays import Floats

TOLERANCE = 1e-9
"""Largest relative residual of the differential equations."""


class NotSolvedError(RuntimeError):
    """A boundary value problem has no solution near the guess, or another than the wanted one."""


def solve_boundary_values(
    rate: Any, ends: Any, mesh: Floats, y: Floats, parameters: Floats | None = None
) -> Any:
    """Solve y' = rate(x, y, p) with ends(y(first), y(last), p) = 0, from a guess.

    Without `parameters`, `rate` and `ends` take no p.
    """
    solution = solve_bvp(rate, ends, mesh, y, parameters, tol=TOLERANCE, max_nodes=100_000)
    if not solution.success:
        raise NotSolvedError(solution.message)
    return solution


def positive(name: str, values: ArrayLike) -> Floats:
    """Return `values` as float64 in the same shape.

    Raises:
        ValueError: A value is not finite and > 0.
    """
    array = _real(name, values)
    wrong = array[~(np.isfinite(array) & (array > 0.0))]
    if wrong.size:
        raise ValueError(f"{name}: must be finite and > 0, got {wrong.flat[0]}")
    return array


def within(
    name: str, values: ArrayLike, low: float, high: float, *, open_below: bool = False
) -> Floats:
    """Return `values` as float64 in the same shape.

    Raises:
        ValueError: A value is outside [low, high], or (low, high] with `open_below`.
    """
    array = _real(name, values)
    above = array > low if open_below else array >= low
    wrong = array[~(above & (array <= high))]
    if wrong.size:
        bracket = "(" if open_below else "["
        raise ValueError(
            f"{name}: must be in {bracket}{low:.10g}, {high:.10g}], got {wrong.flat[0]}"
        )
    return array


def _real(name: str, values: ArrayLike) -> Floats:
    array = np.asarray(values)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: must be real numbers, got dtype {array.dtype}")
    return array.astype(np.float64)
