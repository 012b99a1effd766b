"""Line plots as SVG."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from stickslip_services.pages.rendering import render

_WIDTH, _HEIGHT = 560.0, 210.0
_LEFT, _BOTTOM, _TOP, _RIGHT = 58.0, 34.0, 10.0, 12.0
_STROKE = 12.0
"""Half the length of the stroke that shows a curve with one known value [px]."""

Points = Sequence[tuple[float, float]]


def line_plot(
    curves: Mapping[str, Points],
    *,
    x_name: str,
    y_name: str,
    dots: Mapping[str, Points] | None = None,
    is_log: bool = False,
    has_cursor: bool = False,
) -> Markup:
    """Return a figure with curves and dots as SVG. Points that are not finite are left out.

    Args:
        curves: Points (x, y) of each curve by name.
        x_name: Name of the horizontal axis.
        y_name: Name of the vertical axis.
        dots: Points that are drawn one by one, by name.
        is_log: Make each scale logarithmic whose values are all positive.
        has_cursor: Draw the cursor of time, which a script moves from the first x to the last one.
    """
    dots = dots or {}
    values = np.array([point for line in (*curves.values(), *dots.values()) for point in line], dtype=float)
    values = values.reshape(-1, 2)[np.isfinite(values.reshape(-1, 2)).all(axis=1)]
    across = _Scale.of(values[:, 0], is_log=is_log, pad=0.02)
    up = _Scale.of(values[:, 1], is_log=is_log, pad=0.06)

    def x_of(value: float) -> float:
        return _LEFT + across.share(value) * (_WIDTH - _LEFT - _RIGHT)

    def y_of(value: float) -> float:
        return _TOP + (1 - up.share(value)) * (_HEIGHT - _TOP - _BOTTOM)

    def placed(lines: Iterable[Points]) -> list[Points]:
        return [[(x_of(x), y_of(y)) for x, y in line if np.isfinite((x, y)).all()] for line in lines]

    lines = [
        [(line[0][0] - _STROKE, line[0][1]), (line[0][0] + _STROKE, line[0][1])] if len(line) == 1 else line
        for line in placed(curves.values())
    ]
    return Markup(
        render(
            "plot.html",
            x_name=x_name,
            y_name=y_name,
            curve_names=list(curves),
            dot_names=list(dots),
            x_ticks=[(x_of(tick), f"{tick:g}") for tick in across.ticks()],
            y_ticks=[(y_of(tick), f"{tick:g}") for tick in up.ticks()],
            lines=lines,
            dots=[point for line in placed(dots.values()) for point in line],
            cursor=(x_of(values[:, 0].min()), x_of(values[:, 0].max())) if has_cursor and values.size else None,
            width=_WIDTH,
            height=_HEIGHT,
            left=_LEFT,
            right=_WIDTH - _RIGHT,
        )
    )


@dataclass(frozen=True, slots=True)
class _Scale:
    """One axis of a plot: the values at its ends, and whether it is logarithmic."""

    low: float
    high: float
    is_log: bool

    @classmethod
    def of(cls, values: npt.NDArray[np.float64], *, is_log: bool, pad: float) -> "_Scale":
        """Return a scale that holds all values, extended by a share `pad` on both sides."""
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
        if is_log and low > 0.0:
            room = max((high / low) ** pad, 1.005) if high > low else 1.5
            return cls(low / room, high * room, True)
        # The range is at least 1 % of the values, so that the texts of ticks differ.
        room = max(pad * (high - low), 0.005 * max(abs(low), abs(high))) or 0.1
        return cls(low - room, high + room, False)

    def share(self, value: float) -> float:
        """Return the position of a value, from 0 at the lower end to 1 at the upper one."""
        if self.is_log:
            return float(np.log(value / self.low) / np.log(self.high / self.low))
        return (value - self.low) / (self.high - self.low)

    def ticks(self) -> list[float]:
        """Return some round numbers between the ends."""
        if not self.is_log or self.high < 5 * self.low:
            return _ticks(self.low, self.high)
        decades = range(int(np.floor(np.log10(self.low))), int(np.ceil(np.log10(self.high))) + 1)
        factors = (1,) if len(decades) > 4 else (1, 3)
        ticks = [factor * 10.0**decade for decade in decades for factor in factors]
        return [tick for tick in ticks if self.low <= tick <= self.high]


def _ticks(low: float, high: float) -> list[float]:
    """Return three to six round numbers between two others."""
    if high <= low:
        return [low]
    step = 10.0 ** np.floor(np.log10((high - low) / 3))
    step *= next(factor for factor in (1, 2, 5, 10) if (high - low) / (step * factor) <= 6)
    places = np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    return [float(place * step) + 0.0 for place in places]  # + 0.0 turns -0 into 0
