"""Contents of the page of a dataset version: filters, chosen samples, and distributions."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.pages.rendering import grid_maps
from stickslip_services.pages.samples import SampleData

THUMB_SIDE = 112
"""Least shorter side of a picture that a page shows small [px]."""

SHOWN_THUMBS = 48
"""Samples that a page shows at once."""

MAX_STOPS = 101
"""Stops of a slider: one at each percent if an axis has more values."""

MAX_INDEX_DIGITS = 8
"""Digits of the index of a slider's value in an address."""

BARS = (5, 20)
"""Fewest and most bars of a histogram."""

VALUES_PER_BAR = 4
"""Values of a label for each bar, where there are few."""

GROUPS = ("Parameters", "Looks", "Physics", "Checks")
"""Groups of labels, in the order of the pages."""

Flags = npt.NDArray[np.bool_]
Slider = dict[str, Any]


def sliders(spec: JobSpec) -> list[Slider]:
    """Return the names of the axes with more than one value, and at most `MAX_STOPS` values each.

    The values are in order.
    """
    found = []
    for name, column in zip(spec.named_axes, spec.columns(), strict=True):
        values = sorted(set(column))
        if len(values) > MAX_STOPS:
            stops = np.unique(np.linspace(0, len(values) - 1, MAX_STOPS).astype(int))
            values = [values[stop] for stop in stops]
        if len(values) > 1:
            found.append({"name": name, "values": values})
    return found


def thumbs(data: SampleData, query: Mapping[str, str], start: int) -> dict[str, Any]:
    """Return the context of `thumbs.html`: the samples within the filters, from number `start` on.

    The query has the ends of each slider, `NAME.from` and `NAME.to`, as indices into its values;
    `split`, the name of a split; `valid`, yes or no; and `psnr`, the least PSNR of the cloth [dB].
    """
    axes = sliders(data.manifest.spec)
    slots = np.flatnonzero(_within_filters(data, axes, query))
    end = start + SHOWN_THUMBS
    # Of a clip, the middle picture is shown; of a rod, the first view.
    pictured = picture_array(data)
    pictures = None if pictured is None else data.arrays[pictured]
    is_clip = pictures is not None and pictures.dimensions[0] == "frame"
    middle = pictures.shape[0] // 2 if pictures is not None and is_clip else 0
    columns = {axis["name"]: data.label(axis["name"]) for axis in axes}
    return {
        "thumbs": [_thumb(data, columns, slot) for slot in slots[start:end].tolist()],
        "chosen": len(slots),
        "next_start": end if end < len(slots) else None,
        "kept_query": {name: value for name, value in query.items() if name != "start"},
        "has_psnr": "psnr_cloth" in data.arrays,
        "pictured": pictured,
        "picture_index": middle,
        "picture_step": 1 if pictures is None else max(1, min(pictures.shape[1:3]) // THUMB_SIDE),
    }


def _thumb(
    data: SampleData, columns: Mapping[str, npt.NDArray[np.generic]], slot: int
) -> tuple[object, ...]:
    """Return the slot of a sample, its parameters by name, and its rejection."""
    point = {
        name: data.named(data.arrays[name], np.asarray(column[slot]))
        for name, column in columns.items()
    }
    return slot, point, data.rejection(slot)


def _within_filters(data: SampleData, axes: list[Slider], query: Mapping[str, str]) -> Flags:
    """Return which samples are within all filters, by slot."""
    within = np.ones(data.manifest.sample_count, dtype=bool)
    for axis in axes:
        within &= _within_slider(data, axis, query)
    split = query.get("split")
    if split in SPLITS:
        within &= data.label("split") == SPLITS.index(split)
    validity = query.get("valid")
    if validity in ("yes", "no"):
        within &= data.label("valid").astype(bool) == (validity == "yes")
    # A dataset without clips has no PSNR, and the field may hold no number.
    with suppress(ValueError, KeyError):
        within &= np.asarray(data.label("psnr_cloth"), dtype=float) >= float(query["psnr"])
    return within


def _within_slider(data: SampleData, axis: Slider, query: Mapping[str, str]) -> Flags:
    """Return which samples are between the two ends of a slider."""
    values = axis["values"]
    array = data.arrays[axis["name"]]
    first = _index(query.get(f"{axis['name']}.from", ""), default=0)
    last = _index(query.get(f"{axis['name']}.to", ""), default=len(values) - 1)
    chosen = values[first : last + 1]
    column = np.asarray(data.label(array.name), dtype=float)
    if array.categories:
        codes = [array.categories.index(str(value)) for value in chosen]
        return np.isin(column, codes)
    if len(chosen) == len(values):
        # Also samples between two stops, and NaN.
        return np.ones(len(column), dtype=bool)
    if not chosen:
        return np.zeros(len(column), dtype=bool)
    return np.asarray((column >= min(chosen)) & (column <= max(chosen)))


def _index(text: str, *, default: int) -> int:
    """Return an index from an address, or the default if there is none."""
    is_index = text.isdecimal() and len(text) <= MAX_INDEX_DIGITS
    return int(text) if is_index else default


def losses(data: SampleData) -> dict[str, Any]:
    """Return the context of the rejected samples: the first of them, and maps of the grid."""
    spec = data.manifest.spec
    valid = data.label("valid").astype(bool)
    first = [data.rejection(slot) for slot in np.flatnonzero(~valid)[:SHOWN_THUMBS].tolist()]
    maps = grid_maps(spec, valid, ~valid) if first else []
    return {"lost": first, "maps": maps, "count": spec.sample_count}


def picture_array(data: SampleData) -> str | None:
    """Return the name of the array of pictures, None for a dataset without pictures."""
    for name, array in data.arrays.items():
        if array.dimensions[-3:] == ("y", "x", "rgb"):
            return name
    return None


def histograms(data: SampleData) -> list[dict[str, Any]]:
    """Return the distributions of the numeric labels over the valid samples, in order of groups."""
    valid = data.label("valid").astype(bool)
    group_of = groups_of(data)
    found = []
    for name, array in data.arrays.items():
        if not _is_numeric_label(array):
            continue
        values = np.asarray(data.label(name), dtype=float)
        values = values[np.isfinite(values) & valid]
        # A constant needs no picture.
        if values.size < 2 or values.min() == values.max():
            continue
        bars = _bars(values)
        found.append(
            {"name": name, "text": array.description, "bars": bars, "group": group_of[name]}
        )
    return sorted(found, key=lambda histogram: GROUPS.index(histogram["group"]))


def _is_numeric_label(array: ArrayLayout) -> bool:
    """Return whether a label is a quantity: no code, flag or seed."""
    is_number = not array.shape and not array.per_sample and not array.categories
    is_flag = array.dtype == "bool" or array.name in ("split", "valid")
    return is_number and not is_flag and not array.name.endswith("_seed")


def _bars(values: npt.NDArray[np.float64]) -> list[tuple[int, float, float, float]]:
    """Return count, height [% of the highest] and ends of each bar of a histogram."""
    fewest, most = BARS
    bar_count = min(most, max(fewest, values.size // VALUES_PER_BAR))
    counts, bounds = np.histogram(values, bins=bar_count)
    highest = max(int(counts.max()), 1)
    return [
        (int(count), 100 * count / highest, bounds[number], bounds[number + 1])
        for number, count in enumerate(counts)
    ]


def groups_of(data: SampleData) -> dict[str, str]:
    """Return the group of each array, one of `GROUPS`, by name."""
    spec = data.manifest.spec
    groups = dict.fromkeys(data.arrays, "Physics")
    groups |= {array.name: "Looks" for array in spec.looks_arrays()}
    groups |= {array.name: "Checks" for array in spec.check_arrays()}
    groups |= {"split": "Checks", "valid": "Checks"}
    # An axis is a parameter, also if it is one of looks.
    return groups | dict.fromkeys(spec.named_axes, "Parameters")
