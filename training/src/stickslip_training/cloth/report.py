"""One HTML page about the answers of a model, with plots and the largest errors; it needs no other file."""

import base64
import html
import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from stickslip_schemas.store import write_durably

from stickslip_training.cloth.clips import Clips
from stickslip_training.cloth.evaluation import Errors, Measure, Scores
from stickslip_training.cloth.posterior import Posterior, estimates

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_WORST = 8  # clips that are shown
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #1a1a1a; }
table { border-collapse: collapse; margin: 1rem 0; } th, td { padding: .25rem .7rem; text-align: right; }
th:first-child, td:first-child { text-align: left; } tr { border-bottom: 1px solid #ddd; } img { max-width: 100%; }
"""


def write_html(path: Path, title: str, scores: Scores, posterior: Posterior, clips: Clips, notes: list[str]) -> None:
    """Write the page.

    Raises:
        ModuleNotFoundError: matplotlib is not installed (the extra `plots`).
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ModuleNotFoundError("the report needs matplotlib: pip install 'stickslip-training[plots]'") from None

    plots = Figure(figsize=(9.5, 4.5), layout="constrained")
    _plot(plots, scores, posterior, clips)
    worst = Figure(figsize=(9.5, 1.6 * _WORST), layout="constrained")
    _show_worst(worst, posterior, clips)
    parts = [
        f"<h1>{html.escape(title)}</h1>",
        *(f"<p>{html.escape(note)}</p>" for note in notes),
        _table(scores),
        _image(plots, "estimated over true friction, and calibration of the intervals"),
        "<h2>The largest errors</h2>",
        _image(worst, "crops of the clips with the largest errors"),
    ]
    page = f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
    write_durably(path, f"{page}<style>{_STYLE}</style><body>{''.join(parts)}</body></html>".encode())


def _table(scores: Scores) -> str:
    rows: list[tuple[str, Errors]] = [("all clips, material not known", scores.blind)]
    if scores.given is not None:
        rows.append(("all clips, material known", scores.given))
    rows += [(f"mu {name}", part) for name, part in scores.bands.items()]
    rows += [(f"fell to side {name}", part) for name, part in scores.sides.items()]
    lines = [["", "clips", "simulations", "mean error", "below 0.1", "below 0.2", "in 80 % interval", "interval"]]
    for name, part in rows:
        shares = [_percent(each) for each in (part.within_01, part.within_02, part.coverage)]
        cells = [html.escape(name), str(part.clips), str(part.simulations), str(part.mae)]
        lines.append([*cells, *shares, f"{part.width.value:.3f}"])
    body = "".join(f"<tr><td>{'</td><td>'.join(line)}</td></tr>" for line in lines)
    material = ""
    if scores.top_1 is not None and scores.top_2 is not None:
        likeliest, of_two = _percent(scores.top_1), _percent(scores.top_2)
        material = f"<p>The true material is the likeliest in {likeliest}, one of the two likeliest in {of_two}.</p>"
    return f"<table>{body}</table>{material}<p>In brackets: 90 % intervals over simulations (bootstrap).</p>"


def _percent(measure: Measure) -> str:
    return f"{measure.value:.1%} ({measure.low:.0%} to {measure.high:.0%})"


def _plot(figure: "Figure", scores: Scores, posterior: Posterior, clips: Clips) -> None:
    found, (low, high) = estimates(posterior.mu, posterior.bins), (posterior.bins.low, posterior.bins.high)
    left, right = figure.subplots(1, 2)
    bars = np.stack([found.median - found.low, found.high - found.median])
    left.plot([low, high], [low, high], color="#bbb")
    left.errorbar(clips.mu, found.median, np.maximum(bars, 0.0), fmt=".", color="#2b6cb0", elinewidth=0.4)
    left.set(xlabel="true mu", ylabel="estimated mu, 80 % interval", xlim=(low, high), ylim=(low, high))
    right.plot([0, 1], [0, 1], color="#bbb")
    right.plot([float(level) for level in scores.reliability], list(scores.reliability.values()), "o", color="#c8102e")
    right.set(xlabel="level of the central interval", ylabel="share of clips within", xlim=(0, 1), ylim=(0, 1))


def _show_worst(figure: "Figure", posterior: Posterior, clips: Clips) -> None:
    found = estimates(posterior.mu, posterior.bins)
    order = np.argsort(-np.abs(found.median - clips.mu))[:_WORST].tolist()
    for panel, clip in zip(np.ravel(figure.subplots(_WORST, 1)), order, strict=False):
        code = int(clips.material[clip])
        name = posterior.materials[code] if code >= 0 else "unknown material"
        panel.imshow(np.concatenate(list(clips.crops[clip].numpy()), axis=1), cmap="gray", vmin=0, vmax=1)
        panel.set_title(
            f"{name}, mu {clips.mu[clip]:.2f}: estimated {found.median[clip]:.2f} ({found.low[clip]:.2f} to "
            f"{found.high[clip]:.2f}), taken for {posterior.materials[int(posterior.material[clip].argmax())]}",
            fontsize=9,
        )
    for panel in figure.axes:
        panel.set_axis_off()


def _image(figure: "Figure", alt: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=130)
    return f'<img alt="{alt}" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">'
