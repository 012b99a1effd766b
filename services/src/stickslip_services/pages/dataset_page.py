"""The page of a dataset version, for people: how much was accepted, and where in the grid samples were lost.

One HTML file from the manifest alone, without scripts or anything from elsewhere.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import combinations, islice
from typing import Any

from stickslip_schemas.format.manifest import Contents, Manifest
from stickslip_schemas.plan.points import grid

CELLS = 12
"""Most cells of a map along an axis. An axis with no more values than that has a cell for each."""

LISTED = 200
"""Most rejections that the page lists; the manifest has them all."""

_SIDE = 240.0  # of a map [px]
_MARGIN = 58.0


def dataset_page(contents: Contents) -> str:
    """Return the page as HTML."""
    manifest = contents.manifest
    maps = ""
    if not manifest.sections:
        points = list(grid(manifest.spec))
        lost = [rejection.slot for rejection in manifest.rejections]
        axes = [axis for axis in (Axis.of(name, points) for name in manifest.spec.named_axes) if axis.size > 1]
        maps = "".join(_map(across, up, points, lost) for across, up in combinations(axes, 2))
    title = f"{escape(manifest.dataset)}, version {manifest.version}"
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{_STYLE}</style></head><body>
<h1>{title}</h1>
<p class="rate"><b>{manifest.acceptance_rate:.2%}</b> accepted: {manifest.valid_count:,} of
{manifest.sample_count:,} samples</p>
{_facts(contents)}
<h2>What was lost</h2>
{_losses(manifest)}
<h2>Where it was lost</h2>
<p>{_where(manifest, maps)}</p>
<div class="maps">{maps}</div>
{_listed(contents)}
</body></html>
"""


def _facts(contents: Contents) -> str:
    manifest, spec = contents.manifest, contents.manifest.spec
    files = list(contents.files())
    splits = ", ".join(f"{count:,} {name}" for name, count in manifest.split_counts.items())
    rows = [
        ("kind", spec.kind),
        ("grid", " × ".join(f"{name} ({axis.num})" for name, axis in spec.named_axes.items()) + f", {spec.combine}"),
        ("valid samples", splits or "none"),
        ("files", f"{len(files):,}, {sum(file.size for file in files) / 1e6:,.1f} MB"),
        ("certificate", manifest.certificate or "none: no certificate vouches for the physics of this build"),
        ("spec", manifest.spec_digest),
    ]
    return "<table>" + "".join(f"<tr><th>{name}</th><td>{escape(text)}</td></tr>" for name, text in rows) + "</table>"


def _losses(manifest: Manifest) -> str:
    if manifest.valid_count == manifest.sample_count:
        return "<p>No sample was rejected.</p>"
    reasons = Counter(manifest.rejection_counts)
    rows = "".join(
        f"<tr><td>{escape(reason)}</td><td>{count:,}</td><td>{count / manifest.sample_count:.2%}</td></tr>"
        for reason, count in reasons.most_common()
    )
    return f"<table><tr><th>reason</th><th>samples</th><th>of all</th></tr>{rows}</table>"


def _where(manifest: Manifest, maps: str) -> str:
    if manifest.sections:
        return "The grid has too many samples for maps. The label `valid` says of each whether it is there."
    if not maps:
        return "The grid has fewer than two axes with more than one value: there is no map to draw."
    if not manifest.rejections:
        return "Each cell of the maps is a region of the grid. No region has lost a sample."
    return "Each cell is a region of the grid, the redder the larger the share of its samples that was rejected."


def _listed(contents: Contents) -> str:
    manifest = contents.manifest
    if manifest.valid_count == manifest.sample_count:
        return ""
    rows = "".join(
        f"<tr><td>{rejection.slot}</td><td>{escape(str(rejection.reason))}</td><td>{escape(rejection.message)}</td></tr>"
        for rejection in islice(contents.rejections(), LISTED)
    )
    more = manifest.sample_count - manifest.valid_count - LISTED
    rest = f"<p>{more:,} more are in the manifest.</p>" if more > 0 else ""
    return f"<h2>The rejected samples</h2><table><tr><th>slot</th><th>reason</th><th></th></tr>{rows}</table>{rest}"


# --- maps -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of the grid in cells."""

    name: str
    labels: tuple[str, ...]
    """Of the cells where each is one value; else of their bounds, one more than there are cells."""
    size: int
    cell: dict[Any, int]
    """The cell of each value."""

    def bounds(self, cell: int) -> str:
        """Return which values a cell holds."""
        return self.labels[cell] if len(self.labels) == self.size else f"{self.labels[cell]} to {self.labels[cell + 1]}"

    @staticmethod
    def of(name: str, points: Sequence[dict[str, Any]]) -> "Axis":
        """Return an axis in at most `CELLS` cells."""
        values = sorted({point[name] for point in points})
        if len(values) <= CELLS:
            return Axis(name, tuple(map(_text, values)), len(values), {value: i for i, value in enumerate(values)})
        if isinstance(values[0], str):  # names have no distances: as many in each cell
            starts = [values[i * len(values) // CELLS] for i in range(CELLS)]
            return Axis(name, (*starts, values[-1]), CELLS, {v: i * CELLS // len(values) for i, v in enumerate(values)})
        low, high = values[0], values[-1]
        bounds = tuple(_text(low + (high - low) * i / CELLS) for i in range(CELLS + 1))
        cells = {value: min(int(CELLS * (value - low) / (high - low)), CELLS - 1) for value in values}
        return Axis(name, bounds, CELLS, cells)


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float | int) else str(value)


def _map(across: Axis, up: Axis, points: Sequence[dict[str, Any]], lost: Sequence[int]) -> str:
    """Draw the share of samples lost in each cell of two axes, over all values of the others."""

    def cells(chosen: Sequence[dict[str, Any]]) -> Counter[tuple[int, int]]:
        return Counter((across.cell[point[across.name]], up.cell[point[up.name]]) for point in chosen)

    asked, rejected = cells(points), cells([points[slot] for slot in lost])
    width, height = _SIDE / across.size, _SIDE / up.size
    marks = []
    for (i, j), count in sorted(asked.items()):
        share = rejected[i, j] / count
        told = f"{across.name} {across.bounds(i)}, {up.name} {up.bounds(j)}: {rejected[i, j]} of {count} lost"
        marks.append(
            f'<rect x="{_MARGIN + i * width:.1f}" y="{_SIDE - (j + 1) * height:.1f}" width="{width:.1f}" '
            f'height="{height:.1f}" fill="{_color(share)}" data-lost="{rejected[i, j]}">'
            f"<title>{escape(told)}</title></rect>"
        )
    for place, label in _ticks(across):
        marks.append(f'<text x="{_MARGIN + place * width:.1f}" y="{_SIDE + 16:.1f}" class="x">{escape(label)}</text>')
    for place, label in _ticks(up):
        marks.append(
            f'<text x="{_MARGIN - 6:.1f}" y="{_SIDE - place * height + 4:.1f}" class="y">{escape(label)}</text>'
        )
    marks.append(f'<text x="{_MARGIN + _SIDE / 2:.1f}" y="{_SIDE + 36:.1f}" class="x">{escape(across.name)}</text>')
    middle = f"{_SIDE / 2:.1f}"
    marks.append(f'<text x="14" y="{middle}" class="x" transform="rotate(-90 14 {middle})">{escape(up.name)}</text>')
    name = f"lost over {across.name} and {up.name}"
    return (
        f'<svg role="img" aria-label="{escape(name)}" width="{_MARGIN + _SIDE + 22:.0f}" height="{_SIDE + 46:.0f}" '
        f'viewBox="0 -8 {_MARGIN + _SIDE + 22:.0f} {_SIDE + 54:.0f}">{"".join(marks)}</svg>'
    )


def _ticks(axis: Axis) -> list[tuple[float, str]]:
    """Return the places, in cells, and texts of the first, the middle and the last label."""
    shift = 0.5 if len(axis.labels) == axis.size else 0.0
    last = len(axis.labels) - 1
    return [(place + shift, axis.labels[place]) for place in sorted({0, last // 2, last})]


def _color(share: float) -> str:
    """From what is kept, grey-green, through amber to red, all lost."""
    if share == 0.0:
        return "#dfeee6"
    return f"hsl({46.0 * (1.0 - share):.0f} 85% {74.0 - 30.0 * share:.0f}%)"


_STYLE = """
:root { color-scheme: light dark; --ink: #1a1a1a; --quiet: #4f5863; --paper: #fff }
@media (prefers-color-scheme: dark) { :root { --ink: #e8eeeb; --quiet: #a3b0aa; --paper: #121715 } }
body { font: 15px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 68rem; margin: 2rem auto; padding: 0 1rem; overflow-wrap: anywhere }
h1 { font-size: 1.4rem } h2 { font-size: 1.1rem; margin-top: 2rem } .rate b { font-size: 2rem }
table { border-collapse: collapse } th, td { text-align: left; padding: .2rem .9rem .2rem 0; vertical-align: top }
th { color: var(--quiet); font-weight: 500; overflow-wrap: normal } .maps { display: flex; flex-wrap: wrap; gap: 1rem }
svg { max-width: 100%; height: auto } svg text { font: 11px system-ui, sans-serif; fill: var(--quiet) }
svg .x { text-anchor: middle } svg .y { text-anchor: end } rect { stroke: var(--paper); stroke-width: 1 }
"""
