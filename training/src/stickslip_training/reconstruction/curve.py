"""Curves of the rod: cubic B-splines over [0, 1] with evenly spaced knots, (K, 3) control points."""

import numpy as np
from scipy.interpolate import BSpline

from stickslip_training.arrays import Floats

DEGREE = 3


def knots(count: int) -> Floats:
    """Return the knots of splines of `count` control points; the first and the last point are the curve's ends."""
    inner = np.linspace(0.0, 1.0, count - DEGREE + 1)
    return np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])


def basis(s: Floats, count: int, derivative: int = 0) -> Floats:
    """Return B, (n, count): B @ control points are the points, or the derivatives, at s, (n,)."""
    spline = BSpline(knots(count), np.eye(count), DEGREE)
    return np.asarray(spline(s, nu=derivative))


def fit(points: Floats, count: int) -> Floats:
    """Return the control points (count, 3) of the spline nearest to a polyline (n, 3), by its arc length.

    The spline's parameter runs from 0 to 1 whatever the polyline's length.
    """
    s = arc_length(points)
    dense = np.linspace(0.0, s[-1], 4 * count)
    sampled = np.stack([np.interp(dense, s, axis) for axis in points.T], axis=1)
    B = basis(np.linspace(0.0, 1.0, len(dense)), count)
    smooth = 1e-2 * np.diff(np.eye(count), 3, axis=0)
    control: Floats = np.linalg.lstsq(np.vstack([B, smooth]), np.vstack([sampled, np.zeros((count - 3, 3))]))[0]
    return control


def arc_length(points: Floats) -> Floats:
    """Return the length of the polyline (n, 3) up to each of its points, (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])


def at_uniform_arc_length(control: Floats, count: int) -> Floats:
    """Return `count` points of a spline, evenly spaced along its length, ends included."""
    parameter = np.linspace(0.0, 1.0, 20 * len(control))
    length = arc_length(basis(parameter, len(control)) @ control)
    wanted = np.interp(np.linspace(0.0, length[-1], count), length, parameter)
    return np.asarray(basis(wanted, len(control)) @ control)
