"""Contents of the pages of a dataset version: the chosen samples, the distributions of labels, and
one sample.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from io import BytesIO
from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.kinds.cloth.arrays import clip_arrays, solver_arrays
from stickslip_schemas.kinds.cloth.spec import ClipSpec
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.pages.rendering import grid_maps, plot, table
from stickslip_services.pages.samples import SampleData, is_path

SHOWN_THUMBS = 48
STOPS = 101
"""Of a slider: one at each percent where an axis has more values."""
GROUPS = ("Parameters", "Looks", "Physics", "Checks")
"""Groups of labels, in the order of the pages."""


def sliders(spec: JobSpec) -> list[dict[str, Any]]:
    """Return the names of the axes with more than one value, and at most `STOPS` of their values,
    in order.
    """
    found = []
    for name, column in zip(spec.named_axes, spec.columns(), strict=True):
        values = sorted(set(column))
        stops = (
            np.unique(np.linspace(0, len(values) - 1, STOPS).astype(int))
            if len(values) > STOPS
            else range(len(values))
        )
        found.append({"name": name, "values": [values[stop] for stop in stops]})
    return [axis for axis in found if len(axis["values"]) > 1]


def thumbs(data: SampleData, query: Mapping[str, str], start: int) -> dict[str, Any]:
    """Return the context of `thumbs.html`: the samples within the filters, from number `start` on.

    The query has the ends of each slider, `NAME.from` and `NAME.to`, as indices into its values;
    `split`, the name of a split; `valid`, yes or no; and `psnr`, the least PSNR of the cloth [dB].
    """
    axes, valid = sliders(data.manifest.spec), data.label("valid").astype(bool)
    inside = np.ones(data.manifest.sample_count, dtype=bool)
    for axis in axes:
        values, array = axis["values"], data.arrays[axis["name"]]
        column = np.asarray(data.label(array.name), dtype=float)
        places = [query.get(f"{axis['name']}.{end}", "") for end in ("from", "to")]
        first, last = (
            int(place) if place.isdecimal() and len(place) < 9 else None for place in places
        )
        within = values[first or 0 : len(values) if last is None else last + 1]
        if array.categories:
            inside &= np.isin(column, [array.categories.index(str(value)) for value in within])
        elif len(within) < len(values):
            inside &= (column >= min(within, default=np.inf)) & (
                column <= max(within, default=-np.inf)
            )
    if query.get("split") in SPLITS:
        inside &= data.label("split") == SPLITS.index(query["split"])
    if query.get("valid") in ("yes", "no"):
        inside &= valid == (query["valid"] == "yes")
    with suppress(ValueError, KeyError):
        inside &= np.asarray(data.label("psnr_cloth"), dtype=float) >= float(query["psnr"])
    chosen = np.flatnonzero(inside)
    pictured = _pictured(data)  # of a clip, its middle picture is shown; else the first view
    pictures = None if pictured is None else data.arrays[pictured]
    columns = [(axis["name"], data.arrays[axis["name"]], data.label(axis["name"])) for axis in axes]
    shown = [
        (
            slot,
            {name: data.named(array, column[slot]) for name, array, column in columns},
            data.rejection(slot),
        )
        for slot in chosen[start : start + SHOWN_THUMBS].tolist()
    ]
    return {
        "thumbs": shown,
        "chosen": len(chosen),
        "next_start": start + SHOWN_THUMBS if start + SHOWN_THUMBS < len(chosen) else None,
        "kept_query": {name: value for name, value in query.items() if name != "start"},
        "has_psnr": "psnr_cloth" in data.arrays,
        "pictured": pictured,
        "picture_index": pictures.shape[0] // 2
        if pictures is not None and pictures.dimensions[0] == "frame"
        else 0,
    }


def losses(data: SampleData) -> dict[str, Any]:
    """Return the context of the rejected samples: the first of them, and maps of where they are in
    the grid.
    """
    spec, valid = data.manifest.spec, data.label("valid").astype(bool)
    first = [data.rejection(slot) for slot in np.flatnonzero(~valid)[:SHOWN_THUMBS].tolist()]
    return {
        "lost": first,
        "maps": grid_maps(spec, valid, ~valid) if first else [],
        "count": spec.sample_count,
    }


def _pictured(data: SampleData) -> str | None:
    """Return the name of the array of pictures, None for a dataset without pictures."""
    return next(
        (name for name, array in data.arrays.items() if array.dimensions[-3:] == ("y", "x", "rgb")),
        None,
    )


def histograms(data: SampleData) -> list[dict[str, Any]]:
    """Return the distributions of the numeric labels over the valid samples: parameters, looks,
    physics, checks.
    """
    valid, group = data.label("valid").astype(bool), groups_of(data)
    shown = []
    for name, array in data.arrays.items():
        is_number = not (
            array.dtype == "bool" or name in ("split", "valid") or name.endswith("_seed")
        )
        if array.shape or array.per_sample or not is_number:
            continue
        values = np.asarray(data.label(name), dtype=float)
        values = values[np.isfinite(values) & valid]
        if array.categories or values.size < 2 or values.min() == values.max():
            continue
        counts, bounds = np.histogram(values, bins=min(20, max(5, values.size // 4)))
        top = max(int(counts.max()), 1)
        bars = [
            (int(count), 100 * count / top, bounds[i], bounds[i + 1])
            for i, count in enumerate(counts)
        ]
        shown.append({"name": name, "text": array.description, "bars": bars, "group": group[name]})
    return sorted(shown, key=lambda each: GROUPS.index(each["group"]))


def sample_view(data: SampleData, slot: int) -> dict[str, Any]:
    """Return what the page of a sample shows: stills, the layers of the clip, plots, and labels in
    groups.
    """
    pictures, layers, plots = [], [], []
    groups: dict[str, dict[str, tuple[object, str]]] = {name: {} for name in GROUPS}
    group = groups_of(data)
    for name, array in data.arrays.items():
        dimensions = array.dimensions
        if dimensions[:3] == ("frame", "y", "x"):
            layers.append(name)
        elif dimensions[-3:] == ("y", "x", "rgb"):
            pictures.append({"name": name, "count": array.shape[0]})
        elif is_path(array):
            continue
        elif (
            dimensions[:1] in (("point",), ("instant",))
            and len(array.shape) == 2
            and array.shape[1] <= _CURVES
        ):
            plots.append(_plot(data, name, slot))
        elif (
            dimensions[:1] == ("instant",)
            and dimensions[-1] == "xyz"
            and prod(array.shape[1:-1]) <= 2 * _CURVES
        ):
            plots.append(_plot(data, name, slot))
        elif (
            len(array.shape) <= 1
            and name != "sample_key"
            and (not array.shape or array.shape[0] <= 8)
        ):
            text = "" if array.categories else array.description
            groups[group[name]][name] = (data.named(array, data.read(name, slot)), text)
    stored = data.arrays[_pictured(data) or next(iter(data.arrays))]
    chosen = groups["Parameters"]
    groups["Parameters"] = {
        name: chosen[name] for name in data.manifest.spec.named_axes if name in chosen
    }
    timed = [array for array in data.arrays.values() if array.dimensions[:1] == ("instant",)]
    frames = list(range(data.arrays[layers[0]].shape[0])) if layers else []
    return {
        "slot": slot,
        "shard": stored.shard_path(slot // data.manifest.spec.samples_per_file(stored)),
        "pictures": pictures,
        "layers": layers,
        "frames": data.arrays[layers[0]].attributes.get("instants", frames) if layers else [],
        "instants": timed[0].shape[0] if timed else len(frames),
        "rate": timed[0].attributes.get("instants_per_second", 0) if timed else 0,
        "plots": plots,
        "paths": any(map(is_path, data.arrays.values())),
        "has_contact": any(name.endswith(".contact") for name in data.arrays),
        "groups": {title: labels for title, labels in groups.items() if labels},
    }


def groups_of(data: SampleData) -> dict[str, str]:
    """Return the group of each array, one of `GROUPS`, by name."""
    spec = data.manifest.spec
    found = dict.fromkeys(data.arrays, "Physics")
    if isinstance(spec, ClipSpec):
        found |= {array.name: "Looks" for array in clip_arrays(spec)}
        found |= {array.name: "Checks" for array in solver_arrays(spec)}
    return (
        found
        | {"split": "Checks", "valid": "Checks"}
        | dict.fromkeys(spec.named_axes, "Parameters")
    )


def coloured(array: ArrayLayout, values: Any, index: int) -> npt.NDArray[np.uint8]:
    """Return a frame of pictures or of ground truth as sRGB.

    Numbers are scaled by their range over the clip.
    """
    frame = values[index]
    if array.dimensions[-1] == "rgb":
        return np.asarray(frame)
    if "categories" in array.attributes:
        return np.asarray(_PALETTE[frame % len(_PALETTE)])
    finite = values[np.isfinite(values)].astype(np.float32)
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    if low < 0.0:  # of two signs: grey is 0
        low, high = -max(-low, high), max(-low, high)
    share = np.nan_to_num(
        (frame.astype(np.float32) - low) / ((high - low) or 1.0), nan=0.0, posinf=0.0, neginf=0.0
    )
    planes = share.reshape(*share.shape[:2], -1)
    blue = (
        np.full((*share.shape[:2], 3 - planes.shape[2]), 0.5)
        if planes.shape[2] == 2
        else planes[..., :0]
    )
    planes = (
        np.repeat(planes, 3, axis=2)
        if planes.shape[2] == 1
        else np.concatenate([planes, blue], axis=2)
    )
    return np.asarray(255 * planes, dtype=np.uint8)


_OKABE_ITO = bytes.fromhex("000000 e69f00 56b4e9 009e73 f0e442 0072b2 d55e00 cc79a7")
_PALETTE = np.frombuffer(_OKABE_ITO, np.uint8).reshape(-1, 3)
"""Colours of the codes of segments [Okabe and Ito 2008]."""

_COMPONENTS = {"strain": ("twist", "bend 1", "bend 2"), "xyz": ("x", "y", "z")}

_CURVES = 4
"""In one plot; of vectors, of which there is a curve of each length, twice as many."""


def _plot(data: SampleData, name: str, slot: int) -> dict[str, Any]:
    array = data.arrays[name]
    values = np.asarray(data.read(name, slot), dtype=float)
    if values.ndim > 2:
        values = np.linalg.norm(values, axis=-1).reshape(len(values), -1)
    said = array.attributes
    pairs = [
        f"{one}, {other}" for one in said.get("sheets", ()) for other in said.get("others", ())
    ]
    known: Any = said.get("names") or pairs or _COMPONENTS.get(array.dimensions[1], ())
    parts = known if len(known) == values.shape[1] else tuple(map(str, range(values.shape[1])))
    rate = array.attributes.get("instants_per_second")
    x, x_name = np.linspace(0, 1, len(values)), "arc length over L"
    if rate is not None:
        x, x_name = np.arange(len(values)) / rate, "time [s]"
    curves = dict(zip(parts, values.T.tolist(), strict=True))
    return plot(
        table(x.tolist(), curves),
        x_name=x_name,
        y_name=f"{name}: {array.description}",
        is_timed=rate is not None,
    )


def mp4(frames: Sequence[npt.NDArray[np.uint8]]) -> bytes:
    """Return pictures (y, x, rgb) of even sizes as H.264 in MP4, 10 a second.

    Raise ImportError without PyAV.
    """
    import av

    made = BytesIO()
    with av.open(made, "w", format="mp4") as film:
        stream = film.add_stream("libx264", rate=10, options={"crf": "18"})
        (stream.height, stream.width), stream.pix_fmt = frames[0].shape[:2], "yuv420p"
        for frame in frames:
            film.mux(
                stream.encode(
                    av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
                )
            )
        film.mux(stream.encode())
    return made.getvalue()
