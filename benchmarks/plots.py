"""Pictures of protocol results: what was measured, over the master curve.

Other benchmarks import this module; alone it does nothing.
"""

from itertools import cycle

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, ScalarFormatter
from stickslip_sim_core.protocols.result import ProtocolResult, dense_master

# Okabe and Ito's colours, which the colour-blind tell apart.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
SIZE = (6.0, 5.0)  # inches
DPI = 110


def plot(result: ProtocolResult) -> Figure:
    """Draw the measured curves over their master curves, and the relative errors below.

    Curves that differ in their mesh only have a master curve, and a colour, in common.
    """
    figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    colours = cycle(COLOURS)
    drawn: dict[str, str] = {}
    errors = [abs(e) for curve in result.curves for e in curve.errors if 0.0 < abs(e) < np.inf]
    floor = 0.3 * min([0.01 * result.tolerance, *errors])
    for curve in result.curves:
        label = ", ".join(
            _label(result, name, value)
            for name, value in curve.parameters.items()
            if name != "mesh"
        )
        if first := label not in drawn:
            drawn[label] = next(colours)
            above.plot(
                *dense_master(result.protocol, curve),
                color=drawn[label],
                label=f"master curve {label}".strip(),
            )
        measured = "measured" if first else None
        above.plot(
            curve.x, curve.measured, "o", color=drawn[label], markerfacecolor="none", label=measured
        )
        below.plot(
            curve.x, np.maximum(np.abs(curve.errors), floor), "o", color=drawn[label], markersize=3
        )
    scale = "log" if min(result.curves[0].x) > 0.0 else "linear"
    above.set(
        xscale=scale,
        yscale=scale,
        ylabel=result.y_name,
        title=f"{result.protocol}: {_verdict(result)}",
    )
    if scale == "linear":
        above.set_ylim(0.0, 1.3 * max(y for curve in result.curves for y in curve.master))
    above.legend(fontsize="small")
    below.axhline(result.tolerance, color="black", linestyle="--", linewidth=1)
    below.text(
        0.01,
        result.tolerance,
        "tolerance",
        transform=below.get_yaxis_transform(),
        va="bottom",
        fontsize="small",
    )
    below.set(
        yscale="log",
        ylabel="|relative error|",
        xlabel=result.x_name,
        ylim=(0.3 * floor, 50 * result.tolerance),
    )
    for axis, values in (
        (below.xaxis, result.curves[0].x),
        (
            above.yaxis,
            [
                y
                for curve in result.curves
                for y in (*curve.measured, *curve.master)
                if np.isfinite(y)
            ],
        ),
    ):
        if scale == "log" and values and max(values) < 100.0 * min(values):
            axis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0)))
            axis.set_major_formatter(ScalarFormatter())
            axis.set_minor_formatter(ScalarFormatter())
    return figure


def _label(result: ProtocolResult, name: str, value: float) -> str:
    """Return the label of a parameter.

    Settings may have texts for its numbers, for example "0 height, 1 length".
    """
    texts = dict(
        part.split(" ", 1) for part in str(result.settings.get(name, "")).split(", ") if " " in part
    )
    return texts.get(f"{value:g}", f"{name} = {value:g}")


def _verdict(result: ProtocolResult) -> str:
    return f"largest error {result.error:.1e}, {'passed' if result.passed else 'FAILED'}"
