"""Whether the values of three resolutions converge: limit and order are stated only then."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

STEADY = 1e-3
"""Largest spread of values, over the expected one, that counts as no change with resolution."""

STEADY_AT_ZERO = 0.01
"""The same where 0 is expected, in the unit of the value: a displacement of 0.01 mm."""

ORDERS = (0.5, 6.0)
"""Range of orders with which errors may fall. Chance and noise show others."""


@dataclass(frozen=True)
class Convergence:
    """The finding of three resolutions."""

    limit: float
    """Value of small cells, NaN if the values do not converge."""

    order: float
    """Power of the size of a cell with which errors fall, NaN if they show none."""

    reason: str
    """Why there is no limit or no order; empty if there are both."""


def converged(cells: Sequence[int], values: Sequence[float | None], expected: float) -> Convergence:
    """Return limit and order of y(h) = limit + c h^p through three values [Richardson 1911].

    Values converge if their differences have one sign and fall with an order in `ORDERS`. Values
    that hardly change have converged, without an order.

    Args:
        cells: Numbers of cells, from the coarsest resolution to the finest.
        values: Values, or None.
        expected: The value of the closed form, which gives the scale.
    """
    present = [value for value in values if value is not None]
    if len(present) != 3 or len(values) != 3:
        return Convergence(math.nan, math.nan, "needs three values")
    tolerance = STEADY * abs(expected) if expected else STEADY_AT_ZERO
    if max(present) - min(present) <= tolerance:
        return Convergence(present[-1], math.nan, "does not change")
    first = present[0] - present[1]
    second = present[1] - present[2]
    sizes = [1.0 / count for count in cells]
    if first * second <= 0.0:
        return Convergence(math.nan, math.nan, "does not converge: goes up and down")
    order = _order(sizes, first / second)
    if math.isnan(order):
        return Convergence(
            math.nan, math.nan, f"does not converge: its changes fall by {first / second:.2g}"
        )
    last = sizes[1] / sizes[2]
    return Convergence(present[2] - second / (last**order - 1.0), order, "")


def _order(sizes: Sequence[float], ratio: float) -> float:
    """Return p with (h1^p - h2^p) / (h2^p - h3^p) = ratio, or NaN if it is outside of `ORDERS`."""

    def missed(p: float) -> float:
        a, b, c = (float(size**p) for size in sizes)
        return (a - b) / (b - c) - ratio

    low, high = ORDERS
    # The quotient grows with p.
    if missed(low) > 0.0 or missed(high) < 0.0:
        return math.nan
    for _ in range(60):
        middle = 0.5 * (low + high)
        if missed(middle) > 0.0:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)
