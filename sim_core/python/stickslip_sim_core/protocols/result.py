"""Results of protocols: measured curves beside their master curves.

They say whether the curves agree, and have points for pictures.
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
    """What three meshes say about the points of a curve."""

    cells: tuple[Numbers, ...]
    """By mesh, the coarsest first, and point: cells along the sheet. The last mesh is that of
    `Curve.measured`.
    """

    measured: tuple[Numbers, ...]
    """By mesh and point."""

    limit: Numbers
    """Values extrapolated to cells of no size [Richardson 1911]."""

    order: Numbers
    """Power of the cell's size with which errors fall; NaN where the meshes show none, and 2 was
    taken.
    """

    @classmethod
    def of(
        cls, cells: tuple[Numbers, ...], sizes: tuple[Numbers, ...], measured: tuple[Numbers, ...]
    ) -> "Refinement":
        """Extrapolate what was measured with cells of three `sizes`, by mesh and point."""
        points = zip(zip(*sizes, strict=True), zip(*measured, strict=True), strict=True)
        limits = [_extrapolated(at, values) for at, values in points]
        limit, order = zip(*limits, strict=True) if limits else ((), ())
        return cls(cells, measured, limit, order)


ORDERS = (1.0, 4.0)
"""Orders that three meshes are believed to show. Others are those of values that differ by rounding
or chance.
"""


def _extrapolated(sizes: Numbers, values: Numbers) -> tuple[float, float]:
    """Return limit and order p of y(h) = limit + c h^p through three values, coarsest first."""

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
    """One measured curve beside its master curve. NaN: nothing to measure, such as no boundary."""

    parameters: Mapping[str, float]
    """What is fixed along the curve, such as Poisson's ratio."""

    x: Numbers
    measured: Numbers
    master: Numbers
    refinement: Refinement | None = None
    """Of a protocol that is run on three meshes."""

    @property
    def errors(self) -> Numbers:
        """Measured over master less one; zero where both are NaN, infinite where one is."""
        return self._errors_of(self.measured)

    @property
    def limit_errors(self) -> Numbers:
        """The same of the limit, if the curve has one."""
        return self._errors_of(self.refinement.limit) if self.refinement else ()

    @property
    def errors_by_mesh(self) -> tuple[Numbers, ...]:
        """The same by mesh, the coarsest first, if there are several."""
        return (
            tuple(self._errors_of(measured) for measured in self.refinement.measured)
            if self.refinement
            else ()
        )

    def as_dict(self) -> dict[str, Any]:
        """Return parameters, points and errors; for three meshes also limits and orders."""
        found = {
            name: getattr(self, name)
            for name in ("parameters", "x", "measured", "master", "errors")
        }
        if self.refinement:
            found |= {name: getattr(self.refinement, name) for name in ("limit", "order", "cells")}
            found |= {"limit_errors": self.limit_errors, "errors_by_mesh": self.errors_by_mesh}
        return found

    def _errors_of(self, values: Numbers) -> Numbers:
        return tuple(_relative_error(*pair) for pair in zip(values, self.master, strict=True))


@dataclass(frozen=True)
class ProtocolResult:
    """The result of a protocol: see docs/protocols.md for the definitions."""

    protocol: str
    x_name: str
    y_name: str
    curves: tuple[Curve, ...]
    tolerance: float
    """Largest |relative error| that passes."""

    settings: Mapping[str, Setting]
    build_hash: str
    """`build_info().build_hash` of the core that was measured."""

    limit_tolerance: float | None = None
    """Largest |relative error| of a limit that passes, of a protocol that is run on three meshes.
    """

    @property
    def error(self) -> float:
        """Largest |relative error| over all curves; infinite if nothing was measured."""
        errors = chain.from_iterable(curve.errors for curve in self.curves)
        return max(map(abs, errors), default=math.inf)

    @property
    def limit_error(self) -> float | None:
        """Largest |relative error| of a limit; None without three meshes."""
        if self.limit_tolerance is None:
            return None
        errors = chain.from_iterable(curve.limit_errors for curve in self.curves)
        return max(map(abs, errors), default=math.inf)

    @property
    def passed(self) -> bool:
        limit = self.limit_error
        return self.error <= self.tolerance and (
            limit is None or limit <= (self.limit_tolerance or 0.0)
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the result in JSON's types; NaN and infinity become None."""
        numbers = (
            "protocol",
            "tolerance",
            "error",
            "limit_tolerance",
            "limit_error",
            "passed",
            "build_hash",
        )
        found: dict[str, Any] = _plain(
            {"x": self.x_name, "y": self.y_name, **{name: getattr(self, name) for name in numbers}}
        )
        settings = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in self.settings.items()
        }
        return found | {
            "settings": settings,
            "curves": [_plain(curve.as_dict()) for curve in self.curves],
        }


def _relative_error(measured: float, master: float) -> float:
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


POINTS = 200  # of a master curve

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

    It is exact where the master curve has a formula or a quick solver. Elsewhere it is the monotone
    cubic [Fritsch, Carlson 1980] through the exact values: for pictures only. A single point
    without a formula has no curve.
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
    if first > 0.0 and np.all(y > 0.0):
        dense = np.geomspace(first, last, POINTS)
        return dense, np.exp(PchipInterpolator(np.log(x), np.log(y))(np.log(dense)))
    dense = np.linspace(first, last, POINTS)
    return dense, np.asarray(PchipInterpolator(x, y)(dense))
