"""Pictures of protocol results: what was measured, over the master curve.

They need matplotlib: `pip install stickslip-sim-core[plots]`.
"""

from collections.abc import Callable, Mapping
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import PchipInterpolator

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.protocols.result import Curve, ProtocolResult
from stickslip_sim_core.protocols.stick_slip import EXTENDED, SLIP, STICK
from stickslip_sim_core.reference import master_curves

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which the colour-blind tell apart.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
SIZE = (6.0, 5.0)  # inches
DPI = 110
POINTS = 200  # of a master curve


def figures(result: ProtocolResult) -> list["Figure"]:
    """Draw a result, and the phase diagram of Stick-Slip."""
    return [plot(result), plot_stick_slip_phases(result)] if result.protocol == "stick-slip" else [plot(result)]


def plot(result: ProtocolResult) -> "Figure":
    """Draw the measured curves over their master curves, and the relative errors below.

    Curves that differ in their mesh only have a master curve, and a colour, in common.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, ScalarFormatter

    figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    colours = cycle(COLOURS)
    drawn: dict[str, str] = {}
    errors = [abs(e) for curve in result.curves for e in curve.errors if 0.0 < abs(e) < np.inf]
    floor = 0.3 * min([0.01 * result.tolerance, *errors])
    for curve in result.curves:
        label = ", ".join(_label(result, name, value) for name, value in curve.parameters.items() if name != "mesh")
        if first := label not in drawn:
            drawn[label] = next(colours)
            above.plot(*dense_master(result.protocol, curve), color=drawn[label], label=f"master curve {label}".strip())
        measured = "measured" if first else None
        above.plot(curve.x, curve.measured, "o", color=drawn[label], markerfacecolor="none", label=measured)
        below.plot(curve.x, np.maximum(np.abs(curve.errors), floor), "o", color=drawn[label], markersize=3)
    scale = "log" if min(result.curves[0].x) > 0.0 else "linear"
    above.set(xscale=scale, yscale=scale, ylabel=result.y_name, title=f"{result.protocol}: {_verdict(result)}")
    if scale == "linear":
        above.set_ylim(0.0, 1.3 * max(y for curve in result.curves for y in curve.master))
    above.legend(fontsize="small")
    below.axhline(result.tolerance, color="black", linestyle="--", linewidth=1)
    below.text(
        0.01, result.tolerance, "tolerance", transform=below.get_yaxis_transform(), va="bottom", fontsize="small"
    )
    below.set(yscale="log", ylabel="|relative error|", xlabel=result.x_name, ylim=(0.3 * floor, 50 * result.tolerance))
    for axis, values in (
        (below.xaxis, result.curves[0].x),
        (above.yaxis, [y for curve in result.curves for y in (*curve.measured, *curve.master) if np.isfinite(y)]),
    ):
        if scale == "log" and values and max(values) < 100.0 * min(values):
            axis.set_minor_locator(LogLocator(subs=(2.0, 3.0, 5.0)))
            axis.set_major_formatter(ScalarFormatter())
            axis.set_minor_formatter(ScalarFormatter())
    return figure


def _label(result: ProtocolResult, name: str, value: float) -> str:
    """Return the label of a parameter: settings may have texts for its numbers, such as "0 height, 1 length"."""
    texts = dict(part.split(" ", 1) for part in str(result.settings.get(name, "")).split(", ") if " " in part)
    return texts.get(f"{value:g}", f"{name} = {value:g}")


def _verdict(result: ProtocolResult) -> str:
    return f"largest error {result.error:.1e}, {'passed' if result.passed else 'FAILED'}"


def plot_stick_slip_phases(result: ProtocolResult) -> "Figure":
    """Draw the phase diagram of Stick-Slip over friction and strain, with the master curve."""
    from matplotlib.figure import Figure

    strain_c, mu_c = master_curves.stick_slip_triple_point()
    figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    axes = figure.subplots()
    strain = strain_c * np.linspace(0.0, 1.0, 60)[1:] ** 2
    axes.plot(np.append(0.0, master_curves.stick_slip(strain)), np.append(0.0, strain), color="black")
    axes.plot([mu_c, 0.55], [strain_c, strain_c], color="black", linestyle="--", linewidth=1)
    axes.plot([mu_c, mu_c], [strain_c, 0.45], color="black", linestyle="--", linewidth=1)
    axes.plot(mu_c, strain_c, "*", color="black", markersize=10, label="triple point")
    mu, at, regime = (np.array(result.settings[f"phase_{name}"]) for name in ("mu", "strain", "regime"))
    for value, name, colour in zip(
        (STICK, SLIP, EXTENDED), ("stick", "slip", "extended contact"), COLOURS, strict=False
    ):
        axes.plot(mu[regime == value], at[regime == value], "o", color=colour, markersize=4, label=f"measured: {name}")
    axes.text(mu_c + 0.005, 0.445, "mu_c", va="top")
    axes.text(0.548, strain_c + 0.004, "eps_c", ha="right")
    axes.set(xlabel="mu", ylabel="eps (strain)", xlim=(0.0, 0.55), ylim=(0.0, 0.45))
    axes.set_title("Stick-Slip: master curve (line), measured (dots)")
    figure.legend(fontsize="small", loc="outside lower center", ncols=2)
    return figure


_EXACT: Mapping[str, Callable[[Floats], Floats]] = {
    "cantilever": master_curves.cantilever,
    "rod-cantilever": master_curves.cantilever,
    "inclined-plane": lambda mu: mu,
    "stacked-incline": lambda mu: mu,
    "stick-slip": lambda mu: mu,
    "rod-lateral-buckling": lambda poisson: np.full_like(poisson, master_curves.lateral_buckling_rod()),
}


def dense_master(protocol: str, curve: Curve) -> tuple[Floats, Floats]:
    """Return 200 abscissae between the measured ones, and the master curve there.

    It is exact where the master curve has a formula or a quick solver. Elsewhere it is the monotone cubic [Fritsch,
    Carlson 1980] through the exact values: for pictures only. A single point without a formula has no curve.
    """
    x, y = np.array(curve.x), np.array(curve.master)
    known = np.isfinite(x) & np.isfinite(y)
    x, order = np.unique(x[known], return_index=True)
    y = y[known][order]
    if len(x) == 0:
        return x, y
    dense = _spread(x)
    if protocol in _EXACT:
        return dense, np.asarray(_EXACT[protocol](dense), dtype=np.float64)
    if len(x) < 2:
        return x, y
    is_log = bool(x[0] > 0.0 and np.all(y > 0.0))
    dense = np.geomspace(x[0], x[-1], POINTS) if is_log else np.linspace(x[0], x[-1], POINTS)
    if is_log:
        return dense, np.exp(PchipInterpolator(np.log(x), np.log(y))(np.log(dense)))
    return dense, np.asarray(PchipInterpolator(x, y)(dense))


def _spread(x: Floats) -> Floats:
    """Return abscissae from the first to the last measured one, or around a single one."""
    first, last = (x[0], x[-1]) if len(x) > 1 else (x[0] / 1.5, x[0] * 1.5)
    return np.geomspace(first, last, POINTS) if first > 0.0 else np.linspace(first, last, POINTS)
