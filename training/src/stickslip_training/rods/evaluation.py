"""Errors of the curvature that networks, and methods that learn nothing, find of the same noisy rods.

kappa = (twist, bend1, bend2) L are the strains of a rod. Its centreline has the curvature |kappa| = sqrt(bend1^2 +
bend2^2) L: the twist is that of the material about the centreline, which an estimate from the centreline alone cannot
see. So errors that compare methods are errors of |kappa|.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch

from stickslip_training.arrays import AnyFloats, Floats, SingleFloats
from stickslip_training.rods.baselines import (
    cubic_spline_curvature,
    finite_difference_curvature,
    quintic_spline_curvature,
)
from stickslip_training.rods.dataset import Rods, with_white_noise

_CHUNK = 256  # rods that go through a network at once
_TEST = 2  # stream of random numbers of the noise on test rods, apart from those of training


@dataclass(frozen=True, kw_only=True)
class MethodReport:
    """How well one method finds the curvature of the test rods. Errors are of |kappa|."""

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


def bending(strains: AnyFloats) -> Floats:
    """Return |kappa| L, (..., points), of strains (..., points, 3)."""
    return np.asarray(np.hypot(strains[..., 1], strains[..., 2]), dtype=np.float64)


def rms(difference: AnyFloats) -> float:
    """Return the root mean square of all entries."""
    return float(np.sqrt(np.mean(np.square(difference, dtype=np.float64))))


def relative_rms_error(estimate: AnyFloats, truth: AnyFloats) -> Floats:
    """Return the RMS relative error of each rod, (rods,), of |kappa| L, (rods, points):

    sqrt(mean_s (estimate - truth)^2) / sqrt(mean_s truth^2), over all points, the ends included.
    """
    error = np.sqrt(np.mean(np.square(estimate - truth, dtype=np.float64), axis=-1))
    return np.asarray(error / np.sqrt(np.mean(np.square(truth, dtype=np.float64), axis=-1)))
