"""Pictures of a training run. Needs matplotlib (the extra `plots`)."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stickslip_training.engine.files import MODEL_NAME
from stickslip_training.rods.baselines import quintic_spline_curvature
from stickslip_training.rods.curvature import CurvatureTraining, TrainingReport, load_model, read_test_rods
from stickslip_training.rods.dataset import POINTS
from stickslip_training.rods.evaluation import bending, estimate_strains, relative_rms_error

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TRUTH, _NETWORK, _SPLINE, _MUTED = "#1a1a1a", "#c8102e", "#2b6cb0", "#8a8f98"
_QUANTILES = (0.1, 0.5, 0.9)
"""Which test rods are drawn, by the network's error: a good one, the middle one, a bad one."""


def plot_curvature(config: CurvatureTraining, report: TrainingReport, path: Path) -> None:
    """Draw |kappa| along three test rods, true and estimated, and the losses of the run; write a PNG."""
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        raise ModuleNotFoundError("pictures need matplotlib: pip install 'stickslip-training[plots]'") from None

    rods, noisy = read_test_rods(config)
    truth = bending(rods.strains)
    network = bending(estimate_strains(load_model(config.out / MODEL_NAME), noisy))
    errors = relative_rms_error(network, truth)
    order = np.argsort(errors)
    chosen = [int(order[round(q * (len(order) - 1))]) for q in _QUANTILES]
    spline = quintic_spline_curvature(noisy[chosen])
    spline_errors = relative_rms_error(spline, truth[chosen])

    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 2)
    s = np.linspace(0.0, 1.0, POINTS)
    for place, (rod, quantile) in enumerate(zip(chosen, _QUANTILES, strict=True)):
        panel: Axes = axes.flat[place]
        panel.plot(s, truth[rod], color=_TRUTH, linewidth=2.2, label="true")
        panel.plot(s, spline[place], color=_SPLINE, linewidth=1.2, label=f"quintic spline, {spline_errors[place]:.0%}")
        panel.plot(s, network[rod], color=_NETWORK, linewidth=1.4, label=f"network, {errors[rod]:.0%}")
        # A spline's wild ends must not flatten what there is to see.
        panel.set_ylim(0.0, 1.35 * max(truth[rod].max(), float(np.quantile(network[rod], 0.98))))
        panel.set_xlim(0.0, 1.0)
        panel.set_xlabel("arc length s / L (clamp at 0)")
        panel.set_ylabel("|κ| L [rad]")
        panel.set_title(f"{_ordinal(quantile)} test rod by the network's error (slot {rods.slots[rod]})", fontsize=10)
        panel.legend(frameon=False, fontsize=8.5, loc="upper right", ncols=3, columnspacing=1.0)
    _plot_losses(axes.flat[3], report)
    for panel in axes.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(colors=_MUTED, labelcolor=_TRUTH, labelsize=8.5)
    figure.suptitle(
        f"Curvature from a centreline with {config.noise:.2%} noise: {report.dataset} v{report.version}, "
        f"{report.rods['train']} rods, {report.steps} steps in {report.seconds:.0f} s",
        fontsize=11,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def _plot_losses(panel: Any, report: TrainingReport) -> None:
    steps = [epoch.step for epoch in report.history]
    panel.plot(steps, [epoch.train_loss for epoch in report.history], color=_MUTED, marker=".", label="training")
    validation = [(epoch.step, epoch.validation_loss) for epoch in report.history if epoch.validation_loss is not None]
    if validation:
        panel.plot(*zip(*validation, strict=True), color=_NETWORK, marker=".", label="validation")
    panel.axvline(report.best_step, color=_MUTED, linewidth=0.8, linestyle=":")
    panel.annotate(
        " model",
        (report.best_step, 1.0),
        xycoords=("data", "axes fraction"),
        ha="right" if report.best_step > steps[-1] / 2 else "left",
        va="top",
        fontsize=8.5,
        color=_MUTED,
    )
    losses = [loss for epoch in report.history for loss in (epoch.train_loss, epoch.validation_loss) if loss]
    if max(losses) > 4 * min(losses):
        panel.set_yscale("log")
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter("{x:g}")
    panel.set_xlabel("step")
    panel.set_ylabel("RMS loss [rad]")
    panel.set_title("Loss over all three strains times L", fontsize=10)
    panel.legend(frameon=False, fontsize=8.5)


def _ordinal(quantile: float) -> str:
    return {0.1: "10 %", 0.5: "Median", 0.9: "90 %"}[quantile]
