"""One HTML page about how good answers are, with pictures of the worst cases; nothing outside it is needed to
read it."""

import base64
import html
import struct
import zlib
from pathlib import Path

import numpy as np
from stickslip_schemas.store import write_durably

from stickslip_training.arrays import Array
from stickslip_training.cloth.clips import Clips
from stickslip_training.cloth.evaluation import Errors, Measure, Scores
from stickslip_training.cloth.posterior import Posterior, estimates

_WORST = 8  # clips that are shown
_SIZE = 320  # of a plot [px]
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #1a1a1a; }
table { border-collapse: collapse; margin: 1rem 0; } th, td { padding: .25rem .7rem; text-align: right; }
th:first-child, td:first-child { text-align: left; } tr { border-bottom: 1px solid #ddd; }
figure { display: inline-block; margin: .5rem 1rem .5rem 0; } img { display: block; image-rendering: pixelated; }
figcaption { font-size: 13px; color: #555; } svg text { font-size: 11px; fill: #555; }
"""


def write_html(path: Path, title: str, scores: Scores, posterior: Posterior, clips: Clips, notes: list[str]) -> None:
    """Write the page."""
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        *(f"<p>{html.escape(note)}</p>" for note in notes),
        _table(scores),
        _figure(_scatter(posterior, clips), "Estimated over true friction. Bars are 80 % intervals."),
        _figure(_reliability(scores), "Share of the clips within the central interval of each level."),
        "<h2>The largest errors</h2>",
        *_worst(posterior, clips),
    ]
    page = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
    write_durably(path, f"{page}<style>{_STYLE}</style><body>{''.join(parts)}</body></html>".encode())


def _table(scores: Scores) -> str:
    rows: list[tuple[str, Errors]] = [("all clips, material not known", scores.blind)]
    if scores.given is not None:
        rows.append(("all clips, material known", scores.given))
    rows += [(f"mu {name}", part) for name, part in scores.bands.items()]
    rows += [(f"fell to side {name}", part) for name, part in scores.sides.items()]
    heads = ("", "clips", "simulations", "mean error", "below 0.1", "below 0.2", "in 80 % interval", "interval")
    lines = ["<tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>"]
    for name, part in rows:
        cells = [html.escape(name), str(part.clips), str(part.simulations), _number(part.mae)]
        cells += [_percent(each) for each in (part.within_01, part.within_02, part.coverage)]
        lines.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in [*cells, f"{part.width.value:.3f}"]) + "</tr>")
    material = "" if scores.top_1 is None else f"<p>Material: the likeliest is the true one in {_percent(scores.top_1)}"
    if scores.top_2 is not None and material:
        material += f", one of the two likeliest in {_percent(scores.top_2)}."
    return f"<table>{''.join(lines)}</table>{material}<p>In brackets: 90 % intervals over simulations (bootstrap).</p>"


def _number(measure: Measure) -> str:
    return f"{measure.value:.3f} ({measure.low:.3f}&ndash;{measure.high:.3f})"


def _percent(measure: Measure) -> str:
    return f"{measure.value:.1%} ({measure.low:.0%}&ndash;{measure.high:.0%})"


def _figure(content: str, caption: str) -> str:
    return f"<figure>{content}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _plot(inner: list[str], low: float, high: float, x: str, y: str) -> str:
    ticks = "".join(
        f'<text x="{_at(v, low, high):.0f}" y="{_SIZE + 32}" text-anchor="middle">{v:g}</text>'
        f'<text x="24" y="{_SIZE + 20 - (_at(v, low, high) - 30):.0f}" text-anchor="end">{v:g}</text>'
        for v in np.linspace(low, high, 5)
    )
    frame = f'<rect x="30" y="20" width="{_SIZE}" height="{_SIZE}" fill="none" stroke="#999"/>'
    line = f'<line x1="30" y1="{_SIZE + 20}" x2="{_SIZE + 30}" y2="20" stroke="#bbb"/>'
    words = f'<text x="{_SIZE / 2 + 30}" y="{_SIZE + 48}" text-anchor="middle">{x}</text><text x="30" y="14">{y}</text>'
    return f'<svg width="{_SIZE + 50}" height="{_SIZE + 55}">{frame}{line}{ticks}{words}{"".join(inner)}</svg>'


def _at(value: float, low: float, high: float) -> float:
    return 30 + _SIZE * (value - low) / (high - low)


def _scatter(posterior: Posterior, clips: Clips) -> str:
    found, (low, high) = estimates(posterior.mu, posterior.bins), (posterior.bins.low, posterior.bins.high)
    inner = []
    for mu, median, a, b in zip(clips.mu, found.median, found.low, found.high, strict=True):
        x, y, y_a, y_b = (_at(value, low, high) for value in (mu, median, a, b))
        y, y_a, y_b = (_SIZE + 50 - value for value in (y, y_a, y_b))
        inner.append(f'<line x1="{x:.1f}" y1="{y_a:.1f}" x2="{x:.1f}" y2="{y_b:.1f}" stroke="#2b6cb0" opacity=".25"/>')
        inner.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.2" fill="#2b6cb0"/>')
    return _plot(inner, low, high, "true mu", "estimated mu")


def _reliability(scores: Scores) -> str:
    points = [(float(level), share) for level, share in scores.reliability.items()]
    inner = [
        f'<circle cx="{_at(x, 0, 1):.1f}" cy="{_SIZE + 50 - _at(y, 0, 1):.1f}" r="4" fill="#c8102e"/>'
        for x, y in points
    ]
    return _plot(inner, 0.0, 1.0, "level", "share of clips")


def _worst(posterior: Posterior, clips: Clips) -> list[str]:
    found = estimates(posterior.mu, posterior.bins)
    order = np.argsort(-np.abs(found.median - clips.mu))[:_WORST]
    figures = []
    for clip in order.tolist():
        code = int(clips.material[clip])
        name = posterior.materials[code] if code >= 0 else "unknown material"
        likeliest = posterior.materials[int(posterior.material[clip].argmax())]
        caption = (
            f"{name}, mu {clips.mu[clip]:.2f}: estimated {found.median[clip]:.2f} "
            f"({found.low[clip]:.2f} to {found.high[clip]:.2f}), taken for {likeliest}"
        )
        strip = np.concatenate(list((clips.crops[clip].numpy() * 255).astype(np.uint8)), axis=1)
        data = base64.b64encode(png(strip)).decode()
        figures.append(_figure(f'<img alt="" src="data:image/png;base64,{data}">', caption))
    return figures


def png(picture: Array) -> bytes:
    """Return a PNG file of grey levels (height, width), uint8."""
    height, width = picture.shape

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    rows = b"".join(b"\0" + row.tobytes() for row in np.ascontiguousarray(picture))
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
