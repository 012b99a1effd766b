"""Cubic splines with uniform knots on [0, 1], as matrices: fields along a rod are linear in their coefficients."""

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from stickslip_sim_core.arrays import Floats

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


def bspline_matrix(intervals: int, s: Floats) -> Floats:
    """Return the cubic B-splines on `intervals` equal intervals at s (p,), shape (p, intervals + 3)."""
    from scipy.interpolate import BSpline  # here, so that importing the package stays quick

    knots = np.arange(-3.0, intervals + 4.0) / intervals
    return np.asarray(BSpline.design_matrix(s, knots, 3, extrapolate=True).toarray())


@lru_cache(maxsize=64)
def _interpolants(samples: int, derivative: int) -> "BSpline":
    from scipy.interpolate import make_interp_spline

    s = np.linspace(0.0, 1.0, samples)
    return make_interp_spline(s, np.eye(samples), k=min(3, samples - 1)).derivative(derivative)


def interpolation_matrix(samples: int, s: Floats, derivative: int = 0) -> Floats:
    """Return the matrix (p, samples) from values at uniform arc length to the interpolant's values at s (p,).

    Four samples or more: the cubic spline with not-a-knot ends. Three, two, one: the parabola, line, constant.
    """
    if samples == 1:
        return np.full((len(s), 1), 0.0 if derivative else 1.0)
    return np.asarray(_interpolants(samples, derivative)(s))
