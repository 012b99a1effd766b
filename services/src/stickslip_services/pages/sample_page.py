"""Contents of the page of a sample: stills, the layers of the clip, plots, and labels in groups."""

from collections.abc import Mapping, Sequence
from enum import Enum, auto
from math import prod
from typing import Any

import numpy as np
from stickslip_schemas.spec.arrays import ArrayLayout

from stickslip_services.pages.browsing import GROUPS, groups_of, picture_array
from stickslip_services.pages.choosing import sliders
from stickslip_services.pages.motion import is_path
from stickslip_services.pages.rendering import number, plot, table
from stickslip_services.pages.samples import SampleData

MAX_CURVES = 4
"""Curves in one plot. Of vectors there may be twice as many, since each has one, its length."""

MAX_LABEL_NUMBERS = 8
"""Numbers of a label that the page lists."""

_COMPONENTS = {"strain": ("twist", "bend 1", "bend 2"), "xyz": ("x", "y", "z")}


class View(Enum):
    """How a page shows an array."""

    layer = auto()
    """A layer of the player: the clip, or its ground truth."""
    picture = auto()
    path = auto()
    """In the view in three dimensions."""
    plot = auto()
    label = auto()
    hidden = auto()


def view_of(array: ArrayLayout) -> View:
    """Return how a page shows an array, by its dimensions."""
    dimensions = array.dimensions
    if dimensions[:3] == ("frame", "y", "x"):
        return View.layer
    if dimensions[-3:] == ("y", "x", "rgb"):
        return View.picture
    if is_path(array):
        return View.path
    if _is_plotted(array):
        return View.plot
    is_short = not array.shape or (len(array.shape) == 1 and array.shape[0] <= MAX_LABEL_NUMBERS)
    if is_short and array.name != "sample_key":
        return View.label
    return View.hidden


def _is_plotted(array: ArrayLayout) -> bool:
    """Return whether an array is a few numbers, or vectors, along a rod or over time."""
    dimensions = array.dimensions
    is_along = dimensions[:1] in (("point",), ("instant",))
    if is_along and len(array.shape) == 2 and array.shape[1] <= MAX_CURVES:
        return True
    is_vector = dimensions[:1] == ("instant",) and dimensions[-1] == "xyz"
    return is_vector and prod(array.shape[1:-1]) <= 2 * MAX_CURVES


def sample_view(data: SampleData, slot: int) -> dict[str, Any]:
    """Return the context of a sample on its page."""
    spec = data.manifest.spec
    names: dict[View, list[str]] = {view: [] for view in View}
    for name, array in data.arrays.items():
        names[view_of(array)].append(name)

    stored = data.arrays[picture_array(data) or next(iter(data.arrays))]
    shard = stored.shard_path(slot // spec.samples_per_file(stored))
    layers = names[View.layer]
    frames: list[int] = []
    shown_instants: list[int] = []
    if layers:
        clip = data.arrays[layers[0]]
        frames = list(range(clip.shape[0]))
        # A frame of a clip shows one of the instants of the motion.
        shown_instants = clip.attributes.get("instants", frames)

    groups = _labels(data, names[View.label], slot)
    timed = [array for array in data.arrays.values() if array.dimensions[:1] == ("instant",)]
    return {
        "slot": slot,
        "shard": shard,
        "pictures": [
            {"name": name, "count": data.arrays[name].shape[0], "size": _size(data, name, slot)}
            for name in names[View.picture]
        ],
        "layers": layers,
        "size": _size(data, layers[0], slot) if layers else None,
        "frames": shown_instants,
        "instants": timed[0].shape[0] if timed else len(frames),
        "rate": timed[0].attributes.get("instants_per_second", 0) if timed else 0,
        "plots": [_plot(data, name, slot) for name in names[View.plot]],
        "paths": bool(names[View.path]),
        "has_contact": any(name.endswith(".contact") for name in data.arrays),
        "groups": groups,
        "caption": _caption(data, groups),
    }


def _size(data: SampleData, name: str, slot: int) -> tuple[int, int]:
    """Return width and height of the pictures of a sample in an array (n, y, x, ...) [px]."""
    height, width = data.arrays[name].shape[1:3]
    size = data.picture_size(slot)
    return (width, height) if size is None else (int(size[0]), int(size[1]))


def _caption(data: SampleData, groups: Mapping[str, Mapping[str, tuple[object, str]]]) -> str:
    """Return the parameters of a sample that differ between samples, for example `mu 0.3`."""
    varied = {axis["name"] for axis in sliders(data.manifest.spec)}
    parameters = groups.get("Parameters", {})
    return ", ".join(
        f"{name} {number(value)}" for name, (value, _) in parameters.items() if name in varied
    )


def _labels(
    data: SampleData, names: list[str], slot: int
) -> dict[str, dict[str, tuple[object, str]]]:
    """Return value and description of labels by name, in groups."""
    groups: dict[str, dict[str, tuple[object, str]]] = {name: {} for name in GROUPS}
    group_of = groups_of(data)
    for name in names:
        array = data.arrays[name]
        value = data.named(array, data.read(name, slot))
        # A seed counts nothing, so its digits are not grouped.
        if name.endswith("seed"):
            value = str(value)
        # The name of a code says enough.
        description = "" if array.categories else array.description
        groups[group_of[name]][name] = (value, description)
    # Parameters are in the order of the spec.
    parameters = groups["Parameters"]
    order = [name for name in data.manifest.spec.named_axes if name in parameters]
    groups["Parameters"] = {name: parameters[name] for name in order}
    return {title: labels for title, labels in groups.items() if labels}


def _plot(data: SampleData, name: str, slot: int) -> dict[str, Any]:
    """Return the plot of an array over time, or along a rod."""
    array = data.arrays[name]
    values = np.asarray(data.read(name, slot), dtype=float)
    if values.ndim > 2:
        # Vectors: a curve for the length of each.
        values = np.linalg.norm(values, axis=-1).reshape(len(values), -1)
    rate = array.attributes.get("instants_per_second")
    if rate is None:
        x = np.linspace(0, 1, len(values))
        x_name = "arc length over L"
    else:
        x = np.arange(len(values)) / rate
        x_name = "time [s]"
    curve_names = _curve_names(array, values.shape[1])
    curves = dict(zip(curve_names, values.T.tolist(), strict=True))
    curve = plot(
        table(x.tolist(), curves),
        x_name=x_name,
        y_name=f"{name}: {array.description}",
        is_timed=rate is not None,
    )
    return {**curve, "name": name}


def _curve_names(array: ArrayLayout, count: int) -> tuple[str, ...]:
    """Return the names of the curves of an array: its own, of pairs, of components, or numbers."""
    attributes = array.attributes
    pairs = [
        f"{sheet}, {other}"
        for sheet in attributes.get("sheets", ())
        for other in attributes.get("others", ())
    ]
    components = _COMPONENTS.get(array.dimensions[1], ())
    names: Sequence[str] = attributes.get("names") or pairs or components
    if len(names) == count:
        return tuple(names)
    return tuple(map(str, range(count)))
