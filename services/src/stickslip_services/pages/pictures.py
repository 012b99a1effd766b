"""Pictures for pages: PNG files of arrays, and line plots as SVG."""

import struct
import zlib
from collections.abc import Sequence
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


def line_plot(
    x: Sequence[float],
    curves: dict[str, Sequence[float]],
    *,
    x_name: str,
    y_name: str,
    dots: dict[str, Sequence[float]] | None = None,
) -> Markup:
    """Return an SVG of curves over `x`; `dots` are drawn as points. What is not finite is left out."""
    dots = dots or {}
    values = np.array([*curves.values(), *dots.values()], dtype=float)
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    pad = 0.06 * (high - low) or max(abs(high), 1.0) * 0.1
    low, high = low - pad, high + pad
    first, last = (float(min(x)), float(max(x))) if len(x) else (0.0, 1.0)
    span = (last - first) or 1.0

    def place(at: float, value: float) -> tuple[float, float]:
        across = _LEFT + (at - first) / span * (_WIDTH - _LEFT - _RIGHT)
        return across, _TOP + (high - value) / (high - low) * (_HEIGHT - _TOP - _BOTTOM)

    parts = [f'<svg class="plot" role="img" viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}">']
    parts.append(f"<title>{escape(y_name)} over {escape(x_name)}: {escape(', '.join([*curves, *dots]))}</title>")
    for tick in _ticks(low, high):
        _, y = place(first, tick)
        parts.append(f'<line class="rule" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="y" x="{_LEFT - 6}" y="{y + 4:.1f}">{tick:g}</text>')
    for tick in _ticks(first, last):
        across, _ = place(tick, low)
        parts.append(f'<text class="x" x="{across:.1f}" y="{_HEIGHT - 18:.1f}">{tick:g}</text>')
    parts.append(f'<text class="x" x="{_WIDTH / 2:.0f}" y="{_HEIGHT - 3:.0f}">{escape(x_name)}</text>')
    for position, (_, line) in enumerate(curves.items()):
        points = [place(at, value) for at, value in zip(x, line, strict=True) if np.isfinite(value)]
        text = " ".join(f"{across:.1f},{y:.1f}" for across, y in points)
        parts.append(f'<polyline class="line c{position % 6}" points="{text}"/>')
    for position, (_, line) in enumerate(dots.items()):
        for across, y in (place(at, value) for at, value in zip(x, line, strict=True) if np.isfinite(value)):
            parts.append(f'<circle class="dot c{position % 6}" cx="{across:.1f}" cy="{y:.1f}" r="3"/>')
    parts.append("</svg>")
    legend = "".join(
        f'<li><span class="swatch c{position % 6}"></span>{escape(name)}</li>'
        for position, name in enumerate(dict.fromkeys([*curves, *dots]))
    )
    return Markup(f"<figure>{''.join(parts)}<figcaption>{escape(y_name)}<ul>{legend}</ul></figcaption></figure>")


def _ticks(low: float, high: float) -> list[float]:
    """Return three to six round numbers between two others."""
    if high <= low:
        return [low]
    step = 10.0 ** np.floor(np.log10((high - low) / 3))
    step *= next(factor for factor in (1, 2, 5, 10) if (high - low) / (step * factor) <= 6)
    places = np.arange(np.ceil(low / step), np.floor(high / step) + 1)
    return [float(place * step) + 0.0 for place in places]  # + 0.0 turns -0 into 0
