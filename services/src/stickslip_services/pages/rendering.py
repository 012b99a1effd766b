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
from stickslip_schemas.scene.document import Scene
from stickslip_schemas.scene.library import load_scene, scene_names
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.addresses import prefix, url
from stickslip_services.units import duration, percent, size

STATIC = Path(__file__).parent / "static"

_POLICY = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
        "media-src 'self' blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Vary": "Authorization",
}
"""Headers of all pages: they load and send nothing elsewhere, and nobody keeps them."""


def html_page(template: str, status: int = 200, **values: object) -> Response:
    """Return a rendered template with its security headers. All of its values are escaped."""
    content = _environment().get_template(template).render(**values)
    return Response(content, status, media_type="text/html", headers=_POLICY)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Curves keep their order, and a script of the page could not read NaN.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    filters = (duration, size, percent, number, moment, ago, words, plain, capitalized)
    environment.globals |= {"root": prefix, "service_url": url}
    environment.filters |= {function.__name__: function for function in filters}
    return environment


def spec_document(spec: JobSpec) -> dict[str, Any]:
    """Return a spec as JSON without defaults; an axis of values is their list, or the only one."""
    document = spec.model_dump(mode="json", exclude_defaults=True) | {"kind": spec.kind}
    for name, axis in document["axes"].items():
        if axis["type"] == "list":
            values = axis["values"]
            document["axes"][name] = values[0] if len(values) == 1 else values
    if spec.has_scene:
        document["scene"] = _scene_entry(spec.scene)  # type: ignore[attr-defined]  # `has_scene`
    return document


def _scene_entry(scene: Scene) -> str | dict[str, Any]:
    """Return what a spec says for a scene: the name of a built-in one, or its document."""
    whole = scene.model_dump(mode="json")
    for name, built_in in _built_in_scenes().items():
        if whole == built_in:
            return name
    return scene_document(scene)


@cache
def _built_in_scenes() -> dict[str, dict[str, Any]]:
    return {name: load_scene(name).model_dump(mode="json") for name in scene_names()}


def spec_text(spec: JobSpec) -> str:
    """Return a spec as YAML, with short forms of its axes."""
    document = spec_document(spec)
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True, default_flow_style=None)


def scene_document(scene: Scene) -> dict[str, Any]:
    """Return the document of a scene as JSON."""
    # As it was written: without its defaults, a document would lose the types of its parts.
    return scene.model_dump(mode="json", exclude_unset=True)


def scene_text(scene: Scene) -> str:
    """Return the document of a scene as YAML."""
    document = scene_document(scene)
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True, default_flow_style=None)


def number(value: object) -> str:
    """Return a value of a label as text."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.5g}"
    return str(value)


def moment(value: datetime | None) -> str:
    """Return a time as text, to the minute; an empty text for None."""
    return "" if value is None else f"{value:%Y-%m-%d %H:%M} UTC"


def ago(value: datetime) -> str:
    """Return the time since a moment as text, for example `4 min ago`."""
    seconds = time.time() - value.astimezone(UTC).timestamp()
    return f"{duration(max(0.0, seconds))} ago"


def words(value: object) -> str:
    """Return the name of a state or reason as words, without underscores."""
    return str(value).replace("_", " ")


def capitalized(text: str) -> str:
    """Return a text that begins with a capital letter; the names in it stay as they are."""
    return text[:1].upper() + text[1:]


def plain(text: str) -> str:
    """Return a text without the marks of code, which pages do not show."""
    return text.replace("`", "")


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


MAX_CELLS = 12
"""Most cells of a map along an axis. An axis with no more values than that has a cell for each."""

Flags = npt.NDArray[np.bool_]


class Axis(NamedTuple):
    """An axis of the grid, divided into cells."""

    name: str
    texts: list[str]
    """The values of each cell."""
    range: str
    """All values."""
    cell: npt.NDArray[np.int64]
    """The cell of each sample, by slot."""


def grid_maps(
    spec: JobSpec, done: Flags, lost: Flags, *, most: int | None = None
) -> list[dict[str, Any]]:
    """Return maps of all samples for each pair of axes, or for the `most` first pairs.

    `done` and `lost` are by slot. A map has the axes `across` and `up`, and `cells` that hold
    samples, counted from the lower left. A grid with one axis of several values has one map with
    one row.
    """
    columns = [np.asarray(column) for column in spec.columns()]
    slots = np.arange(spec.sample_count)
    if spec.combine == "zip":
        positions = [slots] * len(columns)
    else:
        # The last axis varies fastest.
        positions = list(np.unravel_index(slots, [len(column) for column in columns]))
    axes = []
    for name, column, position in zip(spec.named_axes, columns, positions, strict=True):
        axis = _axis(name, column[position])
        if len(axis.texts) > 1:
            axes.append(axis)
    if len(axes) == 1:
        axes.append(Axis("", [""], "", np.zeros_like(slots)))
    return [_map(across, up, done, lost) for across, up in islice(combinations(axes, 2), most)]


def _axis(name: str, values: npt.NDArray[Any]) -> Axis:
    """Return an axis from the value of each sample."""
    distinct, cell = np.unique(values, return_inverse=True)
    texts = [_text(value) for value in distinct]
    whole_range = texts[0] if len(texts) == 1 else f"{texts[0]} to {texts[-1]}"
    is_name = distinct.dtype.kind == "U"
    if len(distinct) > MAX_CELLS and is_name:
        # Names have no distances: each cell gets as many.
        bounds = -(-np.arange(MAX_CELLS + 1) * len(distinct) // MAX_CELLS)
        texts = [f"{distinct[first]} to {distinct[end - 1]}" for first, end in pairwise(bounds)]
        cell = np.searchsorted(bounds, cell, side="right") - 1
    elif len(distinct) > MAX_CELLS:
        bounds = np.linspace(distinct[0], distinct[-1], MAX_CELLS + 1)
        texts = [f"{_text(low)} to {_text(high)}" for low, high in pairwise(bounds)]
        # The largest value belongs to the last cell.
        cell = np.minimum(np.searchsorted(bounds, values, side="right") - 1, MAX_CELLS - 1)
    return Axis(name, texts, whole_range, cell)


def _text(value: object) -> str:
    return str(value) if isinstance(value, str) else f"{value:.4g}"


def _map(across: Axis, up: Axis, done: Flags, lost: Flags) -> dict[str, Any]:
    """Return a map: the numbers of samples, of those done and of those lost, of each cell."""
    row_count = len(up.texts)
    cell_count = len(across.texts) * row_count
    cell_of_slot = across.cell * row_count + up.cell
    counts = {
        "samples": np.bincount(cell_of_slot, minlength=cell_count),
        "done": np.bincount(cell_of_slot[done], minlength=cell_count),
        "lost": np.bincount(cell_of_slot[lost], minlength=cell_count),
    }
    cells = []
    for cell in np.flatnonzero(counts["samples"]).tolist():
        i, j = divmod(cell, row_count)
        region = f"{across.name} {across.texts[i]}"
        if up.name:
            region += f", {up.name} {up.texts[j]}"
        numbers = {name: int(column[cell]) for name, column in counts.items()}
        cells.append({"i": i, "j": j, "region": region, **numbers})
    return {"across": across, "up": up, "cells": cells}
