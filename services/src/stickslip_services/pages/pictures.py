"""Pictures for pages: PNG files of arrays, and line plots as SVG."""

import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

_WIDTH, _HEIGHT = 560.0, 210.0
_LEFT, _BOTTOM, _TOP, _RIGHT = 58.0, 34.0, 10.0, 12.0


def png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """Return the PNG file of sRGB pixels, (y, x, 3) [PNG specification, 3rd edition]."""
    height, width, _ = pixels.shape
    rows = np.zeros((height, 1 + 3 * width), dtype=np.uint8)  # each row begins with its filter, 0: none
    rows[:, 1:] = pixels.reshape(height, 3 * width)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows.tobytes(), 6)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data)) for name, data in chunks
    )


Points = Sequence[tuple[float, float]]


def line_plot(
    curves: Mapping[str, Points],
    *,
    x_name: str,
    y_name: str,
    dots: Mapping[str, Points] | None = None,
    is_log: bool = False,
) -> Markup:
    """Return an SVG of curves of points (x, y); `dots` are drawn one by one. What is not finite is left out.

    With `is_log`, both scales are logarithmic where all values are positive.
    """
    dots = dots or {}
    values = np.array([point for line in (*curves.values(), *dots.values()) for point in line], dtype=float)
    values = values.reshape(-1, 2)[np.isfinite(values.reshape(-1, 2)).all(axis=1)]
    across = _Scale.of(values[:, 0], is_log=is_log, pad=0.02)
    up = _Scale.of(values[:, 1], is_log=is_log, pad=0.06)
    width, height = _WIDTH - _LEFT - _RIGHT, _HEIGHT - _TOP - _BOTTOM

    def place(point: tuple[float, float]) -> tuple[float, float]:
        return _LEFT + across.share(point[0]) * width, _TOP + (1 - up.share(point[1])) * height

    parts = [f'<svg class="plot" role="img" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}">']
    parts.append(f"<title>{escape(y_name)} over {escape(x_name)}: {escape(', '.join([*curves, *dots]))}</title>")
    for tick in up.ticks():
        y = _TOP + (1 - up.share(tick)) * height
        parts.append(f'<line class="rule" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="y" x="{_LEFT - 6}" y="{y + 4:.1f}">{tick:g}</text>')
    for tick in across.ticks():
        x = _LEFT + across.share(tick) * width
        parts.append(f'<text class="x" x="{x:.1f}" y="{_HEIGHT - 18:.1f}">{tick:g}</text>')
    parts.append(f'<text class="x" x="{_WIDTH / 2:.0f}" y="{_HEIGHT - 3:.0f}">{escape(x_name)}</text>')
    for position, line in enumerate(curves.values()):
        known = [place(point) for point in line if np.isfinite(point).all()]
        if len(known) == 1:  # one value of it is known: a short stroke
            ((x, y),) = known
            known = [(x - 12, y), (x + 12, y)]
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in known)
        parts.append(f'<polyline class="line c{position % 6}" points="{text}"/>')
    for line in dots.values():
        for x, y in (place(point) for point in line if np.isfinite(point).all()):
            parts.append(f'<circle class="dot" cx="{x:.1f}" cy="{y:.1f}" r="3"/>')
    parts.append("</svg>")
    legend = "".join(
        [f'<li><span class="swatch c{position % 6}"></span>{escape(name)}</li>' for position, name in enumerate(curves)]
        + [f'<li><span class="swatch round"></span>{escape(name)}</li>' for name in dots]
    )
    return Markup(f"<figure>{''.join(parts)}<figcaption>{escape(y_name)}<ul>{legend}</ul></figcaption></figure>")


@dataclass(frozen=True, slots=True)
class _Scale:
    """One axis of a plot: the values at its ends, and whether it is logarithmic."""

    low: float
    high: float
    is_log: bool

    @classmethod
    def of(cls, values: npt.NDArray[np.float64], *, is_log: bool, pad: float) -> "_Scale":
        """Return a scale that holds all values, and a share `pad` more on both sides."""
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)
        if is_log and low > 0.0:
            room = max((high / low) ** pad, 1.005) if high > low else 1.5
            return cls(low / room, high * room, True)
        # A scale is never so fine that its numbers look the same.
        room = max(pad * (high - low), 0.005 * max(abs(low), abs(high))) or 0.1
        return cls(low - room, high + room, False)

    def share(self, value: float) -> float:
        """Return where a value lies, from 0 at the lower end to 1 at the upper one."""
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
