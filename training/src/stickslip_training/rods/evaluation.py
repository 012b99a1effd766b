"""How well networks, and methods that learn nothing, find the curvature of the same noisy rods."""

import time
from dataclasses import dataclass

import numpy as np
import torch

from stickslip_training.arrays import Floats, SingleFloats
from stickslip_training.rods.baselines import (
    cubic_spline_curvature,
    finite_difference_curvature,
    quintic_spline_curvature,
)
from stickslip_training.rods.dataset import Rods
from stickslip_training.rods.errors import bending, relative_rms_error, rms
from stickslip_training.rods.noise import with_white_noise

_CHUNK = 256  # rods that go through a network at once
_TEST = 2  # stream of random numbers of the noise on test rods, apart from those of training


@dataclass(frozen=True, kw_only=True)
class MethodReport:
    """How well one method finds the curvature of the test rods. Errors are of |kappa|: see `rods.errors`."""

    method: str
    rms: float
    """RMS error of |kappa| L over all points of all rods [rad]."""
    relative_median: float
    """Median over the rods of the RMS relative error."""
    relative_p90: float
    """90th percentile over the rods of the RMS relative error."""
    seconds_per_rod: float


def noisy_test_centerline(rods: Rods, noise: float, seed: int) -> SingleFloats:
    """Return the centrelines of test rods as all methods see them, (rods, 150, 3)."""
    return with_white_noise(rods.centerline, noise, (seed, _TEST))


def estimate_strains(net: torch.nn.Module, centerline: SingleFloats) -> SingleFloats:
    """Return the strains (twist, bend1, bend2) times L of centrelines over L, both (rods, 150, 3)."""
    device = next(net.parameters()).device
    with torch.inference_mode():
        parts = [
            net(torch.from_numpy(centerline[start : start + _CHUNK]).to(device)).cpu().numpy()
            for start in range(0, len(centerline), _CHUNK)
        ]
    return np.concatenate(parts)


def evaluate(net: torch.nn.Module, rods: Rods, noisy: SingleFloats) -> tuple[tuple[MethodReport, ...], float]:
    """Let every method see the centrelines `noisy` of `rods`; return how each did, and the network's loss [rad]."""
    truth = bending(rods.strains)
    net.eval()
    started = time.perf_counter()
    strains = estimate_strains(net, noisy)
    reports = [_method("network", bending(strains), truth, started)]
    baselines = {
        "quintic spline": quintic_spline_curvature,
        "cubic spline": cubic_spline_curvature,
        "finite differences": finite_difference_curvature,
    }
    for name, method in baselines.items():
        method(noisy[:1])  # the splines' basis is made once, whatever the number of rods
        started = time.perf_counter()
        reports.append(_method(name, method(noisy), truth, started))
    return tuple(reports), rms(strains - rods.strains)


def _method(name: str, estimate: Floats, truth: Floats, started: float) -> MethodReport:
    seconds = (time.perf_counter() - started) / len(truth)
    errors = relative_rms_error(estimate, truth)
    return MethodReport(
        method=name,
        rms=rms(estimate - truth),
        relative_median=float(np.median(errors)),
        relative_p90=float(np.quantile(errors, 0.9)),
        seconds_per_rod=seconds,
    )
