"""Contents of the page of a dataset version: filters, chosen samples, and distributions."""

import shlex
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.spec.arrays import ArrayLayout

from stickslip_services.pages.choosing import Query, choose, sliders, sortable
from stickslip_services.pages.rendering import grid_maps
from stickslip_services.pages.samples import SampleData

THUMB_SIDE = 112
"""Least shorter side of a picture that a page shows small [px]."""

SHOWN_THUMBS = 48
"""Samples that a page shows at once."""

SHOWN_SHARDS = 12
"""Files of an array that the page of a version links to."""

BARS = (5, 20)
"""Fewest and most bars of a histogram."""

VALUES_PER_BAR = 4
"""Values of a label for each bar, where there are few."""

GROUPS = ("Parameters", "Looks", "Physics", "Checks")
"""Groups of labels, in the order of the pages."""

_PLACES = ("start", "part")
"""Parts of a query that say which samples a page shows, and not which are chosen."""


def thumbs(data: SampleData, query: Query, start: int) -> dict[str, Any]:
    """Return the context of `thumbs.html`: the chosen samples from number `start` on."""
    choice = choose(data, query)
    count = len(choice.slots)
    end = start + SHOWN_THUMBS
    # Of a clip, the middle picture is shown; of a rod, the first view.
    pictured = picture_array(data)
    pictures = None if pictured is None else data.arrays[pictured]
    is_clip = pictures is not None and pictures.dimensions[0] == "frame"
    middle = pictures.shape[0] // 2 if pictures is not None and is_clip else 0
    names = [axis["name"] for axis in sliders(data.manifest.spec)]
    # The label by which samples are sorted is shown with them.
    is_sorted_by = {array.name: array.name == query.get("sort") for array in sortable(data)}
    names += [name for name, is_shown in is_sorted_by.items() if is_shown and name not in names]
    columns = {name: data.label(name) for name in names}
    return {
        "thumbs": [_thumb(data, columns, slot) for slot in choice.slots[start:end]],
        "chosen": count,
        "start": start,
        "next_start": end if end < count else None,
        "last_start": max(count - 1, 0) // SHOWN_THUMBS * SHOWN_THUMBS,
        "fault": choice.fault,
        "pull_options": shlex.join(choice.options),
        "kept_query": {name: value for name, value in query.items() if name not in _PLACES},
        "pictured": pictured,
        "picture_index": middle,
        "picture_step": 1 if pictures is None else max(1, min(pictures.shape[1:3]) // THUMB_SIDE),
    }


def shards(data: SampleData) -> list[dict[str, Any]]:
    """Return the arrays of a version with their files: the first `SHOWN_SHARDS` of each.

    A file has its path, and the first and the last of its samples.
    """
    spec = data.manifest.spec
    count = data.manifest.sample_count
    tables = []
    for array in data.arrays.values():
        samples = spec.samples_per_file(array)
        file_count = -(-count // samples)
        files = [
            (array.shard_path(number), number * samples, min((number + 1) * samples, count) - 1)
            for number in range(min(file_count, SHOWN_SHARDS))
        ]
        # What is not one value, such as a clip, comes first: it is what people look for.
        tables.append({"array": array, "files": files, "more": file_count - len(files)})
    return sorted(tables, key=lambda table: bool(table["array"].is_label))


def _thumb(
    data: SampleData, columns: Mapping[str, npt.NDArray[np.generic]], slot: int
) -> tuple[object, ...]:
    """Return the slot of a sample, its parameters by name, and its rejection."""
    point = {
        name: data.named(data.arrays[name], np.asarray(column[slot]))
        for name, column in columns.items()
    }
    return slot, point, data.rejection(slot)


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
    histograms = []
    for name, array in data.arrays.items():
        if not _is_numeric_label(array):
            continue
        values = np.asarray(data.label(name), dtype=float)
        values = values[np.isfinite(values) & valid]
        # A constant needs no picture.
        if values.size < 2 or values.min() == values.max():
            continue
        bars = _bars(values)
        histograms.append(
            {"name": name, "text": array.description, "bars": bars, "group": group_of[name]}
        )
    return sorted(histograms, key=lambda histogram: GROUPS.index(histogram["group"]))


def _is_numeric_label(array: ArrayLayout) -> bool:
    """Return whether a label is a quantity: no code, flag or seed."""
    is_number = not array.shape and not array.per_sample and not array.categories
    is_flag = array.dtype == "bool" or array.name in ("split", "valid")
    return is_number and not is_flag and not array.name.endswith("_seed")


def _bars(values: npt.NDArray[np.float64]) -> list[tuple[int, float, float, float]]:
    """Return count, height [% of the highest] and ends of each bar of a histogram."""
    fewest, most = BARS
    distinct, numbers = np.unique(values, return_counts=True)
    # A grid has few values, and bins between them would be empty.
    if len(distinct) <= most:
        highest = int(numbers.max())
        return [
            (int(number), 100 * number / highest, value, value)
            for value, number in zip(distinct, numbers, strict=True)
        ]
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
