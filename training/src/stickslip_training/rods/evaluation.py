"""Curvature of noisy centrelines without learning, and errors of all methods.

A network has to beat these methods. The curvature of a curve x(s) in any parametrisation is
|x' × x''| / |x'|^3. Points are at uniform arc length, so s is known. Lengths are over L, and so
curvatures are times L. Every method here takes centrelines (rods, points, 3) and returns
|kappa| L, (rods, points).

kappa = (twist, bend1, bend2) L are the strains of a rod. The curvature of its centreline is
|kappa| = sqrt(bend1^2 + bend2^2) L. The twist is that of the material about the centreline, which
no estimate from the centreline alone can see. So errors that compare methods are errors of |kappa|.
"""

import time
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.interpolate import BSpline
from scipy.linalg import eigh

from stickslip_training.arrays import AnyFloats, Floats, SingleFloats

_CHUNK = 256  # rods that go through a network at once


def with_white_noise(centerline: AnyFloats, share: float, seed: tuple[int, ...]) -> SingleFloats:
    """Add independent normal noise to every coordinate of every point.

    `share` is its standard deviation over L.

    The same `seed` gives the same noise. `centerline` is over L, (..., points, 3).
    """
    generator = np.random.default_rng(seed)
    noise = generator.standard_normal(centerline.shape, dtype=np.float32)
    return (centerline + np.float32(share) * noise).astype(np.float32, copy=False)


def finite_difference_curvature(centerline: AnyFloats) -> Floats:
    """Take the derivatives from a point and its two neighbours.

    X'' at an end is that of the point next to it.
    """
    x = np.asarray(centerline, dtype=np.float64)
    h = 1.0 / (x.shape[-2] - 1)
    first = np.gradient(x, h, axis=-2, edge_order=2)
    second = np.empty_like(x)
    second[..., 1:-1, :] = (x[..., 2:, :] - 2 * x[..., 1:-1, :] + x[..., :-2, :]) / h**2
    second[..., 0, :] = second[..., 1, :]
    second[..., -1, :] = second[..., -2, :]
    return _curvature(first, second)


def cubic_spline_curvature(centerline: AnyFloats) -> Floats:
    """Take the derivatives from cubic smoothing splines, the usual ones.

    They minimise the sum of squares plus lambda ∫ |x''|^2, and so they are straight at their ends:
    at the free end a rod has its natural curvature, and they find none.
    `scipy.interpolate.make_smoothing_spline` gives the same splines, at 50 ms each.
    """
    return _spline_curvature(centerline, 2)


def quintic_spline_curvature(centerline: AnyFloats) -> Floats:
    """Take the derivatives from quintic smoothing splines, which penalise ∫ |x'''|^2.

    They may be bent at their ends.

    They halve the error of cubic ones on hanging rods. One order more takes another sixth off, and
    was not worth it.
    """
    return _spline_curvature(centerline, 3)


def _curvature(first: Floats, second: Floats) -> Floats:
    """|x' × x''| / |x'|^3 of x' and x'', (..., points, 3)."""
    return np.asarray(
        np.linalg.norm(np.cross(first, second), axis=-1) / np.linalg.norm(first, axis=-1) ** 3
    )


@cache
def _spline_basis(points: int, order: int) -> tuple[Floats, ...]:
    """Return a basis of the splines of degree 2 `order` - 1 with a knot at each point of [0, 1].

    The arrays are values, first and second derivatives at the points, (points, basis) each, and a,
    (basis,).

    It is orthogonal both in the sum of squares over the points, a, and in the penalty, 1 - a
    [Demmler, Reinsch 1975]: smoothing is a division in it, and every lambda can be tried on every
    curve.
    """
    degree = 2 * order - 1
    s = np.linspace(0.0, 1.0, points)
    knots = np.concatenate([np.zeros(degree), s, np.ones(degree)])
    splines = BSpline(knots, np.eye(points + degree - 1), degree)
    B = splines(s)
    # The penalised derivative is of degree order - 1 between knots: `order` Gauss points integrate
    # its square exactly.
    nodes, weights = np.polynomial.legendre.leggauss(order)
    h = s[1]
    D = splines.derivative(order)((s[:-1, None] + h * (nodes + 1) / 2).ravel())
    P = D.T @ (np.tile(h * weights / 2, points - 1)[:, None] * D)
    P *= np.trace(B.T @ B) / np.trace(
        P
    )  # the scale of lambda is free, and rounding is least where the two are alike
    weight, V = eigh(B.T @ B, B.T @ B + P)
    return (
        B @ V,
        splines.derivative(1)(s) @ V,
        splines.derivative(2)(s) @ V,
        np.clip(weight, 0.0, 1.0),
    )


_SMOOTHING = np.geomspace(1e-3, 1e16, 400)
"""The values of lambda that are tried, in the scale of `_spline_basis`."""

_MOST_FREEDOM = 0.7
"""Most degrees of freedom of a spline, as a share of the points: near 1, cross-validation divides 0
by 0.
"""


def _spline_curvature(centerline: AnyFloats, order: int) -> Floats:
    """Smooth each coordinate by itself, with the lambda of least cross-validation.

    The generalised cross-validation [Craven, Wahba 1979] is

    GCV = (|y - f|^2 / n) / (1 - tr(A) / n)^2, f = A y.
    """
    x = np.asarray(centerline, dtype=np.float64)
    points = x.shape[-2]
    basis, first, second, a = _spline_basis(points, order)
    y = x.swapaxes(-1, -2).reshape(-1, points)
    z = y @ basis
    power = np.square(y).sum(axis=1)
    best = np.full(len(y), np.inf)
    smoothing = np.zeros(len(y))
    for candidate in _SMOOTHING:
        shrunk = 1.0 / (a + candidate * (1.0 - a))  # the coefficients are c = shrunk z
        freedom = float((a * shrunk).sum()) / points
        if freedom > _MOST_FREEDOM:
            continue
        residual = power - np.square(z) @ (shrunk * (2.0 - a * shrunk))  # |y|^2 - 2 c z + a c^2
        score = residual / (1.0 - freedom) ** 2
        better = score < best
        best[better] = score[better]
        smoothing[better] = candidate
    c = z / (a + smoothing[:, None] * (1.0 - a))
    return _curvature(
        *(
            (c @ each.T).reshape(*x.shape[:-2], 3, points).swapaxes(-1, -2)
            for each in (first, second)
        )
    )


# --- errors
# --------------------------------------------------------------------------------------------------


def estimate_strains(net: torch.nn.Module, centerline: SingleFloats) -> SingleFloats:
    """Return the strains (twist, bend1, bend2) times L of centrelines over L.

    Both are (rods, 150, 3).
    """
    device = next(net.parameters()).device
    with torch.inference_mode():
        parts = [
            net(torch.from_numpy(centerline[start : start + _CHUNK]).to(device)).cpu().numpy()
            for start in range(0, len(centerline), _CHUNK)
        ]
    return np.concatenate(parts)


def evaluate(
    net: torch.nn.Module, noisy: SingleFloats, true: SingleFloats
) -> tuple[list[dict[str, Any]], float]:
    """Let every method see noisy centrelines of rods of true strains.

    Return how each did, and the network's loss [rad].
    """
    truth = bending(true)
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
    return reports, rms(strains - true)


def _method(name: str, estimate: Floats, truth: Floats, started: float) -> dict[str, Any]:
    """Return the errors of a method that estimates |kappa| L.

    They are the RMS error over all points of all rods [rad], and the median and 90th percentile
    over the rods of the RMS relative error.
    """
    seconds = (time.perf_counter() - started) / len(truth)
    errors = relative_rms_error(estimate, truth)
    median, p90 = np.quantile(errors, (0.5, 0.9)).tolist()
    report = {
        "method": name,
        "rms": rms(estimate - truth),
        "relative_median": median,
        "relative_p90": p90,
    }
    return report | {"seconds_per_rod": seconds}


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
