"""Pages from templates, and plots and maps for the script of the pages.

All that they load is in `static/`.

A map shows, for a pair of axes of a grid, the outcomes of the samples in each cell.
"""

import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from itertools import combinations, islice, pairwise
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import yaml
from fastapi import Response
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.units import duration, size

STATIC = Path(__file__).parent / "static"

_POLICY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def html_page(template: str, status: int = 200, **values: Any) -> Response:
    """Return a rendered template, all of whose values are escaped, as a response with its security
    headers.
    """
    content = _environment().get_template(template).render(**values)
    return Response(content, status, media_type="text/html", headers=_POLICY)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.policies["json.dumps_kwargs"] = {}  # curves keep their order
    made.filters |= {each.__name__: each for each in (duration, size, number, moment, ago, words)}
    return made


def spec_text(spec: JobSpec) -> str:
    """Return a spec as YAML, with short forms of its axes: a list, or the only value."""
    document = spec.model_dump(mode="json", exclude_defaults=True) | {"kind": spec.kind}
    for name, axis in document["axes"].items():
        if axis["type"] == "list":
            document["axes"][name] = (
                axis["values"][0] if len(axis["values"]) == 1 else axis["values"]
            )
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True, default_flow_style=None)


def number(value: object) -> str:
    """Return a value of a label as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def moment(value: datetime | None) -> str:
    return "" if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


def ago(value: datetime) -> str:
    return f"{duration(max(0.0, time.time() - value.astimezone(UTC).timestamp()))} ago"


def words(value: object) -> str:
    """Return the name of a state or reason as words, without underscores."""
    return str(value).replace("_", " ")


def table(
    x: Iterable[float], curves: Mapping[str, Iterable[float]], *, is_dots: bool = False
) -> dict[str, Any]:
    """Return curves, or dots, by name, over ascending x. What is not finite leaves a gap."""
    known = {
        name: [value if isfinite(value) else None for value in values]
        for name, values in curves.items()
    }
    return {"x": list(x), "curves": known, "dots": is_dots}


def plot(
    *tables: dict[str, Any], x_name: str, y_name: str, is_log: bool = False, is_timed: bool = False
) -> dict[str, Any]:
    """Return a plot for the macro `plot`: curves and dots with the names and units of both axes.

    Logarithmic scales are for values that are all positive; on a plot over time, the cursor of the
    page is drawn.
    """
    return {"tables": tables, "x": x_name, "y": y_name, "log": is_log, "timed": is_timed}


CELLS = 12
"""Most cells of a map along an axis. An axis with no more values than that has a cell for each."""

Flags = npt.NDArray[np.bool_]


class Axis(NamedTuple):
    """An axis of the grid: the values of each cell and of all, as text, and the cell of each
    sample, by slot.
    """

    name: str
    texts: list[str]
    range: str
    cell: npt.NDArray[np.int64]


def grid_maps(
    spec: JobSpec, done: Flags, lost: Flags, *, most: int | None = None
) -> list[dict[str, Any]]:
    """Return maps of all samples, done and lost by slot, for each pair of axes or for the `most`
    first pairs.

    A map has the axes `across` and `up`, and `cells` that hold samples, counted from the lower
    left. A grid with one axis of several values has one map with one row.
    """
    columns = [np.asarray(column) for column in spec.columns()]
    slots = np.arange(spec.sample_count)
    places = (
        [slots] * len(columns)
        if spec.combine == "zip"
        else np.unravel_index(slots, [len(own) for own in columns])
    )
    axes = [
        _axis(name, own[at]) for name, own, at in zip(spec.named_axes, columns, places, strict=True)
    ]
    axes = [axis for axis in axes if len(axis.texts) > 1]
    if len(axes) == 1:
        axes.append(Axis("", [""], "", np.zeros_like(slots)))
    return [_map(across, up, done, lost) for across, up in islice(combinations(axes, 2), most)]


def _axis(name: str, values: npt.NDArray[Any]) -> Axis:
    known, cell = np.unique(values, return_inverse=True)
    texts = [_text(value) for value in known]
    span = texts[0] if len(texts) == 1 else f"{texts[0]} to {texts[-1]}"
    if (
        len(known) > CELLS and known.dtype.kind == "U"
    ):  # names have no distances: each cell gets as many
        first = -(-np.arange(CELLS + 1) * len(known) // CELLS)
        texts = [f"{known[a]} to {known[b - 1]}" for a, b in pairwise(first)]
        cell = np.searchsorted(first, cell, side="right") - 1
    elif len(known) > CELLS:
        bounds = np.linspace(known[0], known[-1], CELLS + 1)
        texts = [f"{_text(a)} to {_text(b)}" for a, b in pairwise(bounds)]
        cell = np.minimum(np.searchsorted(bounds, values, side="right") - 1, CELLS - 1)
    return Axis(name, texts, span, cell)


def _text(value: Any) -> str:
    return str(value) if isinstance(value, str) else f"{value:.4g}"


def _map(across: Axis, up: Axis, done: Flags, lost: Flags) -> dict[str, Any]:
    columns, rows = len(across.texts), len(up.texts)
    place = across.cell * rows + up.cell
    numbers = np.stack(
        [np.bincount(place[of], minlength=columns * rows) for of in (slice(None), done, lost)]
    )
    cells = []
    for at in np.flatnonzero(numbers[0]).tolist():
        i, j = divmod(at, rows)
        region = f"{across.name} {across.texts[i]}" + (
            f", {up.name} {up.texts[j]}" if up.name else ""
        )
        counts = dict(zip(("samples", "done", "lost"), numbers[:, at].tolist(), strict=True))
        cells.append({"i": i, "j": j, "region": region, **counts})
    return {"across": across, "up": up, "cells": cells}
