"""Cubic splines with uniform knots on [0, 1], as matrices: fields along a rod are linear in what describes them."""

from functools import lru_cache

import numpy as np

from stickslip_sim_core.arrays import Floats


def bspline_matrix(intervals: int, s: Floats, derivative: int = 0) -> Floats:
    """Return the values at s, shape (p,), of the cubic B-splines on `intervals` equal intervals, shape
    (p, intervals + 3); or of their derivative of order 1 ... 3. Outside [0, 1] the end polynomials go on."""
    at = np.clip(np.floor(s * intervals).astype(np.int64), 0, intervals - 1)
    u = s * intervals - at
    # The four pieces of a cardinal cubic B-spline, in powers of u.
    pieces = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0
    powers = np.zeros((len(s), 4))
    for k in range(derivative, 4):
        factor = np.prod(np.arange(k - derivative + 1, k + 1))
        powers[:, k] = factor * u ** (k - derivative)
    matrix = np.zeros((len(s), intervals + 3))
    for j in range(4):
        matrix[np.arange(len(s)), at + j] = powers @ pieces[j]
    return matrix * float(intervals) ** derivative


@lru_cache(maxsize=64)
def interpolation_coefficients(samples: int) -> Floats:
    """Return the B-spline coefficients of the interpolant of `samples` values at uniform s = 0 ... 1, shape
    (max(samples - 1, 1) + 3, samples).

    Four samples or more: the cubic spline with not-a-knot ends. Three, two, one: the parabola, line, constant.
    """
    if samples == 1:
        return np.ones((4, 1))
    intervals = samples - 1
    s = np.linspace(0.0, 1.0, samples)
    jumps = np.zeros((0, intervals + 3))
    if samples >= 3:
        # The third derivative does not jump at the first and the last inner knot.
        third = bspline_matrix(intervals, (np.arange(intervals) + 0.5) / intervals, 3) / float(intervals) ** 3
        jumps = np.diff(third, axis=0)[[0, -1]] if samples > 3 else np.stack([third[0], third[1]])
    else:
        jumps = bspline_matrix(1, s, 2)
    system = np.concatenate([bspline_matrix(intervals, s), jumps])
    coefficients = np.linalg.solve(system, np.eye(samples + 2)[:, :samples])
    coefficients.flags.writeable = False
    return coefficients


def interpolation_matrix(samples: int, s: Floats, derivative: int = 0) -> Floats:
    """Return the matrix (p, samples) from values at uniform arc length to the interpolant's values at s, shape (p,)."""
    return bspline_matrix(max(samples - 1, 1), s, derivative) @ interpolation_coefficients(samples)
