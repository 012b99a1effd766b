"""The direction in which a centreline leaves its clamp, and whether that is the clamp's own."""

import numpy as np

from stickslip_sim_core.arrays import Floats

WINDOW = 0.15
"""Arc length next to the clamp from which the direction is read [L].

A rod of the thesis's ranges turns by up to 3 rad there, which a cubic still follows.
"""

MIN_WINDOW_POINTS = 7
"""Points of the window, the clamp included: twice as many as a cubic through the clamp needs."""

MAX_ANGLE = np.pi / 4
"""Largest angle between a centreline and its clamp [rad].

It is half of the angle between level and vertical clamps, so it tells which of them is meant. A
soft rod leaves a level clamp at up to 40 degrees: it bends over the clamp's edge within its own
thickness.
"""

UNCERTAINTIES = 3.0
"""A centreline is refused if its angle exceeds MAX_ANGLE by this many uncertainties."""


def refuse_other_clamp(centerline: Floats, clamp_frame: Floats) -> None:
    """Refuse a centreline (P, 3) [L] that leaves the clamp in another direction than its d1.

    Raises:
        ValueError: The angle is larger than MAX_ANGLE. The message names both directions.
    """
    direction, uncertainty = leaving_direction(centerline)
    tangent = clamp_frame[:, 0]
    angle = _angle(direction, tangent)
    if angle - UNCERTAINTIES * uncertainty > MAX_ANGLE:
        raise ValueError(
            f"centerline: must leave the clamp within {np.degrees(MAX_ANGLE):.0f} degrees of its "
            f"d1, which points {_elevation(tangent)}, and leaves it {_elevation(direction)}, "
            f"{np.degrees(angle):.0f} degrees away; give the clamp_frame of your photograph, or "
            "turn the centreline so that z is up and its first point is the clamp"
        )


def leaving_direction(centerline: Floats) -> tuple[Floats, float]:
    """Return the unit tangent (3,) at the clamp, and its uncertainty [rad].

    The tangent is the slope at s = 0 of the cubic r(s) - r(0) = a s + b s^2 + c s^3 that is nearest
    to the points of the window. Its uncertainty follows from the cubic's residual, which holds the
    noise of the points and what a cubic cannot follow.
    """
    arc = np.linspace(0.0, 1.0, len(centerline))
    points = max(MIN_WINDOW_POINTS, int(np.searchsorted(arc, WINDOW)))
    away = centerline[1:points] - centerline[0]
    arc = arc[1:points]
    powers = arc[:, None] ** np.arange(1, 4)
    coefficients = np.linalg.lstsq(powers, away, rcond=None)[0]
    slope = coefficients[0]
    length = np.linalg.norm(slope)
    if length == 0.0:
        raise ValueError("centerline: must leave its first point, and its first points are equal")

    # Three coordinates a point, and three coefficients for each coordinate.
    residual = away - powers @ coefficients
    variance = (residual**2).sum() / (3 * (len(arc) - 3))
    slope_variance = variance * np.linalg.inv(powers.T @ powers)[0, 0]
    # Only the two components across the slope turn it.
    return slope / length, float(np.sqrt(2.0 * slope_variance) / length)


def _angle(a: Floats, b: Floats) -> float:
    """Return the angle between two vectors [rad]; a right angle where one of them is zero."""
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))


def _elevation(direction: Floats) -> str:
    """Return how a direction stands to the horizon, in words."""
    degrees = np.degrees(np.arctan2(direction[2], np.hypot(direction[0], direction[1])))
    side = "above" if degrees > 0 else "below"
    return f"{abs(degrees):.0f} degrees {side} the horizon"
