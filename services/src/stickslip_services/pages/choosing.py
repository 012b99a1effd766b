"""Which samples of a version the filters of its page choose, and in which order.

A query has the ends of each slider, `NAME.from` and `NAME.to`, as indices into its values; `split`,
the name of a split; `valid`, yes or no; conditions `where0.label`, `where0.operator` and
`where0.value`, `where1.label` and so on; and `sort`, a label, with `order`, ascending or
descending.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from stickslip_schemas.format.selection import Selection
from stickslip_schemas.spec.arrays import SPLITS, ArrayLayout
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.pages.samples import SampleData

MAX_STOPS = 101
"""Stops of a slider: one at each percent if an axis has more values."""

MAX_INDEX_DIGITS = 8
"""Digits of the index of a slider's value in an address."""

CONDITIONS = 2
"""Conditions on labels that the form of the page has."""

OPERATORS = ("<", "<=", ">", ">=", "==", "!=")
"""Operators of a condition, as `stickslip pull --where` has them."""

Flags = npt.NDArray[np.bool_]
Slider = dict[str, Any]
Query = Mapping[str, str]


@dataclass(frozen=True)
class Choice:
    """The chosen samples of a version."""

    slots: list[int]
    """In the order of the page."""
    options: tuple[str, ...]
    """Options of `stickslip pull` that choose the same samples."""
    fault: str
    """Why no condition was applied, or why no sample fits; empty if nothing is wrong."""


def choose(data: SampleData, query: Query) -> Choice:
    """Return the samples within the filters of a query."""
    axes = sliders(data.manifest.spec)
    within = np.ones(data.manifest.sample_count, dtype=bool)
    for axis in axes:
        within &= _within_slider(data, axis, query)
    split = query.get("split")
    if split in SPLITS:
        within &= data.label("split") == SPLITS.index(split)
    validity = query.get("valid")
    if validity in ("yes", "no"):
        within &= data.label("valid").astype(bool) == (validity == "yes")
    where = conditions(query)
    fault = ""
    if where:
        try:
            within &= Selection(where=where).choose_samples(data.arrays.values(), data.label)
        except ValueError as error:
            fault = str(error)
            within[:] = False
    return Choice(_ordered(data, np.flatnonzero(within), query), _options(axes, query), fault)


def conditions(query: Query) -> tuple[str, ...]:
    """Return the conditions on labels of a query, such as `mu<0.5`."""
    texts = []
    for number in range(CONDITIONS):
        label, operator, value = (
            query.get(f"where{number}.{part}", "").strip()
            for part in ("label", "operator", "value")
        )
        # A row of the form that is not filled in is no condition.
        if label and value and operator in OPERATORS:
            texts.append(f"{label}{operator}{value}")
    return tuple(texts)


def _options(axes: list[Slider], query: Query) -> tuple[str, ...]:
    """Return the options of `stickslip pull` for the filters of a query; it takes valid samples."""
    options: list[str] = []
    for axis in axes:
        values = axis["values"]
        first, last = _ends(axis, query)
        if (first, last) == (0, len(values) - 1) or first > last:
            continue
        if first == last:
            options += ["--where", f"{axis['name']}=={values[first]}"]
        elif isinstance(values[0], str):
            # Names have no order: all others are left out.
            left_out = [*values[:first], *values[last + 1 :]]
            for name in left_out:
                options += ["--where", f"{axis['name']}!={name}"]
        else:
            options += ["--where", f"{axis['name']}>={values[first]}"]
            options += ["--where", f"{axis['name']}<={values[last]}"]
    if query.get("split") in SPLITS:
        options += ["--split", query["split"]]
    for condition in conditions(query):
        options += ["--where", condition]
    return tuple(options)


def sortable(data: SampleData) -> list[ArrayLayout]:
    """Return the labels with one value a sample, by which samples are sorted and filtered."""
    return [
        array
        for array in data.arrays.values()
        if array.is_label and not array.shape and array.name not in ("split", "valid")
    ]


def _ordered(data: SampleData, slots: npt.NDArray[np.int64], query: Query) -> list[int]:
    """Return slots in the order of a label; samples that lack it come last."""
    name = query.get("sort", "")
    if name not in {array.name for array in sortable(data)}:
        return [int(slot) for slot in slots]
    array = data.arrays[name]
    values = np.asarray(data.label(name), dtype=float)[slots]
    if array.categories:
        values = _by_name(array, values)
    is_known = np.isfinite(values) & data.label("valid").astype(bool)[slots]
    signed = -values if query.get("order") == "descending" else values
    # Sorting is stable: samples of one value stay in the order of their slots.
    order = np.argsort(np.where(is_known, signed, np.inf), kind="stable")
    return [int(slot) for slot in slots[order]]


def _by_name(array: ArrayLayout, codes: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the places of codes in the alphabetical order of their names."""
    names = list(array.categories)
    places = {code: place for place, code in enumerate(np.argsort(names).tolist())}
    return np.array([places.get(int(code), np.nan) for code in codes], dtype=float)


def sliders(spec: JobSpec) -> list[Slider]:
    """Return the names of the axes with more than one value, and at most `MAX_STOPS` values each.

    The values are in order.
    """
    axes = []
    for name, column in zip(spec.named_axes, spec.columns(), strict=True):
        values = sorted(set(column))
        if len(values) > MAX_STOPS:
            stops = np.unique(np.linspace(0, len(values) - 1, MAX_STOPS).astype(int))
            values = [values[stop] for stop in stops]
        if len(values) > 1:
            axes.append({"name": name, "values": values})
    return axes


def _within_slider(data: SampleData, axis: Slider, query: Query) -> Flags:
    """Return which samples are between the two ends of a slider."""
    values = axis["values"]
    array = data.arrays[axis["name"]]
    first, last = _ends(axis, query)
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


def _ends(axis: Slider, query: Query) -> tuple[int, int]:
    """Return the indices of the first and the last value of a slider within its ends."""
    last = len(axis["values"]) - 1
    return (
        _index(query.get(f"{axis['name']}.from", ""), default=0),
        min(_index(query.get(f"{axis['name']}.to", ""), default=last), last),
    )


def _index(text: str, *, default: int) -> int:
    """Return an index from an address, or the default if there is none."""
    is_index = text.isdecimal() and len(text) <= MAX_INDEX_DIGITS
    return int(text) if is_index else default
