"""Two samples beside each other, of one dataset or of two: one scale, one time, their differences.

What the page of a sample shows of one sample is made in `sample_page`.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from stickslip_services.pages.browsing import GROUPS

View = dict[str, Any]
"""What `sample_page.sample_view` says of a sample, with its `title`."""

UNKNOWN = "–"
"""Stands for the value of a label that a dataset does not have."""


class Timeline(NamedTuple):
    """The cursor of time that all clips, curves and shapes of a page follow."""

    rate: float
    """Instants of the cursor a second; 0 without times."""
    instants: int


class LabelRow(NamedTuple):
    """A label of the samples of a page."""

    name: str
    values: tuple[object, ...]
    text: str


def timeline(views: Sequence[View]) -> Timeline:
    """Return a cursor that runs to the end of the longest sample, in instants of the first one."""
    rate = next((view["rate"] for view in views if view["rate"]), 0)
    if not rate:
        return Timeline(0, max(view["instants"] for view in views))
    # A sample lasts (instants - 1) / rate seconds. What has no time, such as a rod, lasts none.
    seconds = [(view["instants"] - 1) / view["rate"] for view in views if view["rate"]]
    return Timeline(rate, math.ceil(max(seconds) * rate - 1e-9) + 1)


def common_layers(views: Sequence[View]) -> list[str]:
    """Return the layers that all samples with a clip have, in the order of the first one."""
    with_clip = [view["layers"] for view in views if view["layers"]]
    if not with_clip:
        return []
    return [layer for layer in with_clip[0] if all(layer in layers for layers in with_clip)]


def overlaid(views: Sequence[View]) -> list[dict[str, Any]]:
    """Return the plots of one sample, or those of two with the curves of both on one scale."""
    if len(views) == 1:
        plots: list[dict[str, Any]] = views[0]["plots"]
        return plots
    # Arrays of one name hold the same quantity if their axes are the same, too.
    joined: dict[tuple[str, str], dict[str, Any]] = {}
    for position, view in enumerate(views):
        for of_sample in view["plots"]:
            key = (of_sample["name"], of_sample["x"])
            tables = [_named(part, view["title"], position) for part in of_sample["tables"]]
            if key not in joined:
                joined[key] = {**of_sample, "tables": tables}
                continue
            joined_curve = joined[key]
            joined_curve["tables"] += tables
            if of_sample["y"] != joined_curve["y"]:
                # Two kinds may describe one array differently.
                joined_curve["y"] += f"; {view['title']}: {of_sample['y']}"
    return list(joined.values())


def _named(part: dict[str, Any], title: str, position: int) -> dict[str, Any]:
    """Return a table of a plot whose curves name their sample; those of the second are dashed."""
    curves = {f"{title}: {name}": values for name, values in part["curves"].items()}
    return {**part, "curves": curves, "dashed": position > 0}


def label_rows(views: Sequence[View]) -> dict[str, list[LabelRow]]:
    """Return the labels of one sample in groups, or those in which two samples differ."""
    groups: dict[str, list[LabelRow]] = {}
    for title in GROUPS:
        labels = [view["groups"].get(title, {}) for view in views]
        # In the order of the first sample, then what only the second one has.
        names = dict.fromkeys(name for of_sample in labels for name in of_sample)
        rows = [_row(name, labels) for name in names]
        differences = [row for row in rows if len(views) == 1 or len(set(map(str, row.values))) > 1]
        if differences:
            groups[title] = differences
    return groups


def _row(name: str, labels: Sequence[dict[str, tuple[object, str]]]) -> LabelRow:
    values = tuple(of_sample[name][0] if name in of_sample else UNKNOWN for of_sample in labels)
    text = next(of_sample[name][1] for of_sample in labels if name in of_sample)
    return LabelRow(name, values, text)
