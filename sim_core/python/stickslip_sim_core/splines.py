"""Cubic splines as matrices: values at some places times the matrix are values at others.

They need NumPy only, so that the package does.
"""

from functools import lru_cache

import numpy as np

from stickslip_sim_core.arrays import Floats


def bspline_matrix(intervals: int, s: Floats) -> Floats:
    """Return the cubic B-splines on equal intervals of [0, 1] at s (p,): (p, intervals + 3).

    On an interval, with u in [0, 1], four are not zero [de Boor 1978]:

        (1 - u)^3/6,  (3 u^3 - 6 u^2 + 4)/6,  (-3 u^3 + 3 u^2 + 3 u + 1)/6,  u^3/6.
    """
    first = np.clip(np.floor(s * intervals).astype(int), 0, intervals - 1)
    u = s * intervals - first
    pieces = (
        _cube(1.0 - u),
        3.0 * _cube(u) - 6.0 * u**2 + 4.0,
        -3.0 * _cube(u) + 3.0 * u**2 + 3.0 * u + 1.0,
        _cube(u),
    )
    matrix = np.zeros((len(s), intervals + 3))
    for offset, piece in enumerate(pieces):
        matrix[np.arange(len(s)), first + offset] = piece / 6.0
    return matrix


def interpolation_matrix(samples: int, s: Floats, derivative: int = 0) -> Floats:
    """Return the matrix (p, samples) that interpolates values at uniform arc length at s (p,).

    Four samples or more give the cubic spline with not-a-knot ends. Three samples give a parabola,
    two a line, and one a constant.

    Args:
        samples: Number of values, at equal distances on [0, 1].
        s: Where the spline is evaluated (p,).
        derivative: 0 or 1, the derivative by s.
    """
    if samples == 1:
        return np.full((len(s), 1), 0.0 if derivative else 1.0)
    h = 1.0 / (samples - 1)
    left = np.clip(np.floor(s / h).astype(int), 0, samples - 2)
    # The weights of the neighbours, and how they and their cubes change with s.
    b = s / h - left
    a = 1.0 - b
    rows = np.arange(len(s))
    line = np.zeros((len(s), samples))
    bends = _second_derivatives(samples)
    if derivative:
        line[rows, left] = -1.0 / h
        line[rows, left + 1] = 1.0 / h
        low = -(3.0 * a**2 - 1.0) * h / 6.0
        high = (3.0 * b**2 - 1.0) * h / 6.0
    else:
        line[rows, left] = a
        line[rows, left + 1] = b
        low = (_cube(a) - a) * h**2 / 6.0
        high = (_cube(b) - b) * h**2 / 6.0
    return np.asarray(line + low[:, None] * bends[left] + high[:, None] * bends[left + 1])


def _cube(values: Floats) -> Floats:
    """Return the third powers, as products.

    NumPy's power of 3 rounds otherwise on processors with AVX-512 than on others.
    """
    return values * values * values


@lru_cache(maxsize=64)
def _second_derivatives(samples: int) -> Floats:
    """Return the matrix (n, n) from values to second derivatives of the spline at the samples.

    With m'' at equal distances h [de Boor 1978]:

        m''_{i-1} + 4 m''_i + m''_{i+1} = 6/h^2 (y_{i-1} - 2 y_i + y_{i+1}),

    and m'' is linear through the first three and the last three samples. That gives the second and
    the last but one at once: 6 m'' = 6/h^2 (...). Elimination along the samples gives the others.
    Unlike LAPACK, it rounds alike on all processors.
    """
    differences = np.zeros((samples, samples))
    inner = np.arange(1, samples - 1)
    weight = 6.0 * (samples - 1) ** 2
    for offset, coefficient in ((-1, 1.0), (0, -2.0), (1, 1.0)):
        differences[inner, inner + offset] = weight * coefficient
    # A line bends nowhere, and a parabola everywhere alike.
    if samples == 2:
        return differences
    bends = differences / 6.0
    if samples == 3:
        return np.tile(bends[1], (3, 1))
    last = samples - 2
    pivot = np.zeros(samples)
    for k in range(2, last):
        pivot[k] = 1.0 / (4.0 - pivot[k - 1])
        bends[k] = (differences[k] - bends[k - 1]) * pivot[k]
    for k in range(last - 1, 1, -1):
        bends[k] -= pivot[k] * bends[k + 1]
    bends[0] = 2.0 * bends[1] - bends[2]
    bends[-1] = 2.0 * bends[-2] - bends[-3]
    return bends


def hermite(times: Floats, values: Floats, slopes: Floats, at: Floats) -> Floats:
    """Return the cubic Hermite interpolant at times `at` (...) of values (K, ...) with slopes."""
    piece = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    tail = (1,) * (values.ndim - 1)
    h = (times[piece + 1] - times[piece]).reshape(*np.shape(at), *tail)
    s = (at - times[piece]).reshape(*np.shape(at), *tail)
    slope = (values[piece + 1] - values[piece]) / h
    bend = (slopes[piece] + slopes[piece + 1] - 2.0 * slope) / h
    second = (slope - slopes[piece]) / h - bend
    return np.asarray(values[piece] + slopes[piece] * s + second * (s * s) + bend / h * (s * s * s))


def monotone_slopes(times: Floats, values: Floats) -> Floats:
    """Return slopes (K - 2, n) of monotone cubics at inner times [Fritsch and Butland 1984].

    A slope is the weighted harmonic mean of the slopes beside it, and 0 where their signs differ.
    """
    h = np.diff(times)[:, None]
    beside = np.diff(values, axis=0) / h
    before = beside[:-1]
    after = beside[1:]
    turns = (np.sign(before) != np.sign(after)) | (before == 0.0) | (after == 0.0)
    w1 = 2.0 * h[1:] + h[:-1]
    w2 = h[1:] + 2.0 * h[:-1]
    # Quotients of a turn are not used.
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (w1 / before + w2 / after) / (w1 + w2)
        return np.where(turns, 0.0, 1.0 / mean)
