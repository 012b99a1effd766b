"""Results of protocols: measured curves beside their master curves, and whether they agree."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

Numbers = tuple[float, ...]
Setting = float | int | str | Numbers


@dataclass(frozen=True)
class Curve:
    """One measured curve beside its master curve. NaN: nothing to measure, such as no boundary."""

    parameters: Mapping[str, float]
    """What is fixed along the curve, such as Poisson's ratio."""

    x: Numbers
    measured: Numbers
    master: Numbers

    @property
    def errors(self) -> Numbers:
        """Measured over master less one; zero where both are NaN, infinite where one is."""
        return tuple(_relative_error(*pair) for pair in zip(self.measured, self.master, strict=True))


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

    @property
    def error(self) -> float:
        """Largest |relative error| over all curves; infinite if nothing was measured."""
        return max((abs(e) for curve in self.curves for e in curve.errors), default=math.inf)

    @property
    def passed(self) -> bool:
        return self.error <= self.tolerance

    def as_dict(self) -> dict[str, Any]:
        """Return the result in JSON's types; NaN and infinity become None."""
        return {
            "protocol": self.protocol,
            "x": self.x_name,
            "y": self.y_name,
            "tolerance": self.tolerance,
            "error": _number(self.error),
            "passed": self.passed,
            "settings": {
                name: list(value) if isinstance(value, tuple) else value for name, value in self.settings.items()
            },
            "build_hash": self.build_hash,
            "curves": [
                {
                    "parameters": dict(curve.parameters),
                    **{
                        name: [_number(value) for value in getattr(curve, name)]
                        for name in ("x", "measured", "master", "errors")
                    },
                }
                for curve in self.curves
            ],
        }


def _relative_error(measured: float, master: float) -> float:
    if math.isnan(measured) and math.isnan(master):
        return 0.0
    if math.isnan(measured) or math.isnan(master):
        return math.inf
    return measured / master - 1.0


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
