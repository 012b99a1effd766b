"""Plots, which the script of the pages draws with uPlot."""

from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any


def table(x: Iterable[float], curves: Mapping[str, Iterable[float]], *, is_dots: bool = False) -> dict[str, Any]:
    """Return curves, or dots, by name, over ascending x. What is not finite leaves a gap."""
    known = {name: [value if isfinite(value) else None for value in values] for name, values in curves.items()}
    return {"x": list(x), "curves": known, "dots": is_dots}


def plot(
    *tables: dict[str, Any], x_name: str, y_name: str, is_log: bool = False, is_timed: bool = False
) -> dict[str, Any]:
    """Return a plot for the macro `plot`: curves and dots with the names and units of both axes.

    Logarithmic scales are for values that are all positive; on a plot over time, the cursor of the page is drawn.
    """
    return {"tables": tables, "x": x_name, "y": y_name, "log": is_log, "timed": is_timed}
