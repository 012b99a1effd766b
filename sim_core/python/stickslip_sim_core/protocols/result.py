"""Results of protocols: measured curves beside their master curves.

A result states whether the curves agree. `dense_master` returns points for pictures.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.reference import master_curves

Numbers = tuple[float, ...]
Setting = float | int | str | Numbers


@dataclass(frozen=True)
class Refinement:
    """Limits of the points of a curve, from measurements on three meshes."""

    cells: tuple[Numbers, ...]
    """Cells along the sheet, by mesh, the coarsest first, and by point.

    `Curve.measured` belongs to the last mesh.
    """

    measured: tuple[Numbers, ...]
    """Measured values, by mesh and point."""

    limit: Numbers
    """Values extrapolated to cells of size zero [Richardson 1911]."""

    order: Numbers
    """Power of the size of a cell with which errors fall.

    It is NaN if the meshes show no order. The limit then assumes an order of 2.
    """

    @classmethod
    def of(
        cls, cells: tuple[Numbers, ...], sizes: tuple[Numbers, ...], measured: tuple[Numbers, ...]
    ) -> "Refinement":
        """Extrapolate values that were measured with cells of three `sizes`, by mesh and point."""
        points = zip(zip(*sizes, strict=True), zip(*measured, strict=True), strict=True)
        limits = [_extrapolated(at, values) for at, values in points]
        limit, order = zip(*limits, strict=True) if limits else ((), ())
        return cls(cells, measured, limit, order)


ORDERS = (1.0, 4.0)
"""Range of orders that three meshes can show.

Values that differ by rounding or chance show other orders.
"""


def _extrapolated(sizes: Numbers, values: Numbers) -> tuple[float, float]:
    """Return limit and order p of y(h) = limit + c h^p through three values, coarsest first."""

    # Zero if the ratio of both differences fits the order. Products in place of a quotient allow
    # equal values.
    def missed(p: float) -> float:
        a, b, c = (size**p for size in sizes)
        return float((values[0] - values[1]) * (b - c) - (values[1] - values[2]) * (a - b))

    low, high = ORDERS
    order = math.nan
    power = 2.0
    if missed(low) * missed(high) < 0.0:
        order = power = float(brentq(missed, low, high))
    return float(
        values[2] + (values[2] - values[1]) / ((sizes[1] / sizes[2]) ** power - 1.0)
    ), order


@dataclass(frozen=True)
class Curve:
    """One measured curve beside its master curve.

    NaN means that a point has no value, for example because it has no boundary.
    """

    parameters: Mapping[str, float]
    """Parameters that are fixed along the curve, for example Poisson's ratio."""

    x: Numbers
    measured: Numbers
    master: Numbers
    refinement: Refinement | None = None
    """Limits, if the protocol uses three meshes."""

    @property
    def errors(self) -> Numbers:
        """Measured value over master value, minus one, at each point.

        The error is zero if both values are NaN, and infinite if one value is NaN.
        """
        return self._errors_of(self.measured)

    @property
    def limit_errors(self) -> Numbers:
        """Errors of the limit, if the curve has one."""
        return self._errors_of(self.refinement.limit) if self.refinement else ()

    @property
    def errors_by_mesh(self) -> tuple[Numbers, ...]:
        """Errors by mesh, the coarsest first, if the protocol uses three meshes."""
        return (
            tuple(self._errors_of(measured) for measured in self.refinement.measured)
            if self.refinement
            else ()
        )

    def as_dict(self) -> dict[str, Any]:
        """Return parameters, points and errors, and for three meshes also limits and orders."""
        document = {
            name: getattr(self, name)
            for name in ("parameters", "x", "measured", "master", "errors")
        }
        if self.refinement:
            document |= {
                name: getattr(self.refinement, name) for name in ("limit", "order", "cells")
            }
            document |= {"limit_errors": self.limit_errors, "errors_by_mesh": self.errors_by_mesh}
        return document

    def _errors_of(self, values: Numbers) -> Numbers:
        return tuple(_relative_error(*pair) for pair in zip(values, self.master, strict=True))


@dataclass(frozen=True)
class ProtocolResult:
    """The result of a protocol. docs/protocols.md has the definitions."""

    protocol: str
    x_name: str
    y_name: str
    curves: tuple[Curve, ...]
    tolerance: float
    """Largest |relative error| that passes."""

    settings: Mapping[str, Setting]
    build_hash: str
    """`build_info().build_hash` of the measured core."""

    limit_tolerance: float | None = None
    """Largest |relative error| of a limit that passes, if the protocol uses three meshes."""

    @property
    def error(self) -> float:
        """Largest |relative error| over all curves, or infinity without a measurement."""
        errors = chain.from_iterable(curve.errors for curve in self.curves)
        return max(map(abs, errors), default=math.inf)

    @property
    def limit_error(self) -> float | None:
        """Largest |relative error| of a limit, or None without three meshes."""
        if self.limit_tolerance is None:
            return None
        errors = chain.from_iterable(curve.limit_errors for curve in self.curves)
        return max(map(abs, errors), default=math.inf)

    @property
    def passed(self) -> bool:
        """Whether all errors are within their tolerances and every step has converged.

        A step above the tolerance of its preset is no measurement, however small the error is.
        """
        limit = self.limit_error
        return (
            self.error <= self.tolerance
            and (limit is None or limit <= (self.limit_tolerance or 0.0))
            and self.settings.get("unconverged_steps", 0) == 0
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the result in JSON's types. NaN and infinity become None."""
        numbers = (
            "protocol",
            "tolerance",
            "error",
            "limit_tolerance",
            "limit_error",
            "passed",
            "build_hash",
        )
        document: dict[str, Any] = _plain(
            {"x": self.x_name, "y": self.y_name, **{name: getattr(self, name) for name in numbers}}
        )
        settings = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in self.settings.items()
        }
        return document | {
            "settings": settings,
            "curves": [_plain(curve.as_dict()) for curve in self.curves],
        }


def _relative_error(measured: float, master: float) -> float:
    # Both sides agree that there is no value.
    if math.isnan(measured) and math.isnan(master):
        return 0.0
    if math.isnan(measured) or math.isnan(master):
        return math.inf
    return measured / master - 1.0


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, tuple):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# Number of points of a drawn master curve.
POINTS = 200

_EXACT: Mapping[str, Callable[[Floats], Floats]] = {
    "cantilever": master_curves.cantilever,
    "rod-cantilever": master_curves.cantilever,
    "inclined-plane": lambda mu: mu,
    "stacked-incline": lambda mu: mu,
    "stick-slip": lambda mu: mu,
    "rod-lateral-buckling": lambda poisson: np.full_like(
        poisson, master_curves.lateral_buckling_rod()
    ),
}


def dense_master(protocol: str, curve: Curve) -> tuple[Floats, Floats]:
    """Return 200 abscissae between the measured ones, and the master curve there.

    The curve is exact if the master curve has a formula or a quick solver. Otherwise it is the
    monotone cubic [Fritsch, Carlson 1980] through the exact values, for pictures only. A single
    point without a formula has no curve.
    """
    x = np.array(curve.x)
    y = np.array(curve.master)
    known = np.isfinite(x) & np.isfinite(y)
    x, order = np.unique(x[known], return_index=True)
    y = y[known][order]
    if len(x) == 0 or (len(x) == 1 and protocol not in _EXACT):
        return x, y
    first, last = (x[0], x[-1]) if len(x) > 1 else (x[0] / 1.5, x[0] * 1.5)
    if protocol in _EXACT:
        dense = (
            np.geomspace(first, last, POINTS) if first > 0.0 else np.linspace(first, last, POINTS)
        )
        return dense, np.asarray(_EXACT[protocol](dense), dtype=np.float64)
    # Points that span several decades are interpolated in logarithms.
    if first > 0.0 and np.all(y > 0.0):
        dense = np.geomspace(first, last, POINTS)
        return dense, np.exp(PchipInterpolator(np.log(x), np.log(y))(np.log(dense)))
    dense = np.linspace(first, last, POINTS)
    return dense, np.asarray(PchipInterpolator(x, y)(dense))
