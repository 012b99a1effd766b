"""Maps of a parameter grid: for each pair of axes, the outcomes of the samples in each cell."""

from itertools import combinations, islice, pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.jobs import JobSpec

CELLS = 12
"""Most cells of a map along an axis. An axis with no more values than that has a cell for each."""

Flags = npt.NDArray[np.bool_]


class Axis(NamedTuple):
    """An axis of the grid: the values of each cell and of all, as text, and the cell of each sample, by slot."""

    name: str
    texts: list[str]
    range: str
    cell: npt.NDArray[np.int64]


def grid_maps(spec: JobSpec, done: Flags, lost: Flags, *, most: int | None = None) -> list[dict[str, Any]]:
    """Return maps of all samples, done and lost by slot, for each pair of axes or for the `most` first pairs.

    A map has the axes `across` and `up`, and `cells` that hold samples, counted from the lower left. A grid with
    one axis of several values has one map with one row.
    """
    columns = [np.asarray(column) for column in spec.columns()]
    slots = np.arange(spec.sample_count)
    places = [slots] * len(columns) if spec.combine == "zip" else np.unravel_index(slots, [len(own) for own in columns])
    axes = [_axis(name, own[at]) for name, own, at in zip(spec.named_axes, columns, places, strict=True)]
    axes = [axis for axis in axes if len(axis.texts) > 1]
    if len(axes) == 1:
        axes.append(Axis("", [""], "", np.zeros_like(slots)))
    return [_map(across, up, done, lost) for across, up in islice(combinations(axes, 2), most)]


def _axis(name: str, values: npt.NDArray[Any]) -> Axis:
    known, cell = np.unique(values, return_inverse=True)
    texts = [_text(value) for value in known]
    span = texts[0] if len(texts) == 1 else f"{texts[0]} to {texts[-1]}"
    if len(known) > CELLS and known.dtype.kind == "U":  # names have no distances: each cell gets as many
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
    numbers = np.stack([np.bincount(place[of], minlength=columns * rows) for of in (slice(None), done, lost)])
    cells = []
    for at in np.flatnonzero(numbers[0]).tolist():
        i, j = divmod(at, rows)
        region = f"{across.name} {across.texts[i]}" + (f", {up.name} {up.texts[j]}" if up.name else "")
        counts = dict(zip(("samples", "done", "lost"), numbers[:, at].tolist(), strict=True))
        cells.append({"i": i, "j": j, "region": region, **counts})
    return {"across": across, "up": up, "cells": cells}
