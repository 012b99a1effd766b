"""Bending length and natural bend of a thread that hangs over a ledge, with what they are worth.

The thread is a uniform rod in the plane of the photograph. Its weight against its bending rigidity
is gamma = rho A g L^3 / EI, and its bending length is L / gamma^(1/3), which does not depend on L.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stickslip_sim_core.arrays import Floats, check_positive
from stickslip_sim_core.photographs.ruler import Picture, Pixel, Scale
from stickslip_sim_core.photographs.thread import Thread, find_thread, uniform_points
from stickslip_sim_core.rods.clamp import leaving_direction
from stickslip_sim_core.rods.fit import ParameterFit, fit_parameters
from stickslip_sim_core.rods.tilt import TiltedFit, fit_tilted_clamp, tilted_frame

LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Columns d1 = x (away from the ledge), d2 = z (up), d3 = -y (across the photograph)."""

CLAMP_STEP = np.radians(25.0)
"""Distance of the clamps from which the tilt of a part of a thread is fitted [rad]. The steepest
that a multiple reaches is 75 degrees, since a clamp along gravity has no plane of tilt. Rods from
which fits start are kept for each clamp, so few clamps save time.
"""

STEEPEST = 3
"""The steepest of these clamps, in steps."""

POINTS = 101
"""Points of a centreline that is fitted."""

UNKNOWN_ROLL = np.radians(1.0)
"""Standard deviation of the roll of a camera that was held level by eye [rad]."""


@dataclass(frozen=True)
class View:
    """How a photograph shows a thread."""

    ledge: Pixel
    """Pixel (x, y) at which the thread leaves the ledge."""

    scale: Scale
    """Pixels per millimetre in the plane of the thread."""

    side: int = 1
    """1 if the thread hangs to the right of the ledge, -1 if to the left."""

    roll: float = 0.0
    """Angle by which level lines fall to the right in the photograph [rad]."""

    roll_error: float = UNKNOWN_ROLL
    """Standard deviation of the roll [rad]."""


@dataclass(frozen=True, eq=False)
class Bending:
    """A thread over a ledge. Each error is one standard deviation."""

    length: float
    """Length from the ledge to the free end [mm]."""

    bending_length: float
    """L / gamma^(1/3) [mm]."""

    bending_length_error: float
    """Of noise along the thread, its first thickness, the roll and the scale together [mm]."""

    natural_bend: float
    """Curvature without weight, > 0 downwards [1/m]."""

    natural_bend_error: float
    """Of noise along the thread, its first thickness and the roll together [1/m]."""

    clamp_angle: float
    """Angle by which the thread leaves the ledge upwards [rad]."""

    clamp_angle_error: float
    """Of noise along the thread [rad]; 0 for a given angle."""

    residual: float
    """Root mean square distance per coordinate between rod and centreline [mm]."""

    change_at_ledge: float
    """Change of the bending length if the first thickness of the thread is left out [mm]."""

    change_by_roll: float
    """Change of the bending length by one standard deviation of the roll [mm]."""

    trades_bend_for_weight: bool
    """Whether a stiffer thread of another natural bend would hang alike."""

    fitted: Floats
    """The fitted rod, x away from the ledge and z up: (P, 2) [mm]."""


@dataclass(frozen=True)
class JointBending:
    """The bending length of several photographs of the same yarn, of any lengths."""

    bending_length: float
    """Mean, weighted by the inverse square of the errors [mm]."""

    error: float
    """Standard deviation of the mean [mm].

    If the photographs differ by more than their errors, it follows from their scatter.
    """

    scatter: float
    """Standard deviation of the bending lengths of the photographs [mm]."""


def measure_thread(
    picture: Picture, view: View, *, clamp_angle: float | None = None
) -> tuple[Bending, Thread]:
    """Measure the thread of a photograph.

    Args:
        picture: The photograph, blue, green and red, (H, W, 3).
        view: How it shows the thread.
        clamp_angle: Angle by which the thread leaves the ledge upwards [rad]. None fits it.

    Raises:
        ValueError: As for `find_thread` and `measure_centerline`.
        RuntimeError: As for `measure_centerline`.
    """
    thread = find_thread(picture, view.ledge, view.side)
    bending = measure_centerline(
        _in_millimetres(thread.points, view),
        thread.thickness / view.scale.pixels_per_mm,
        clamp_angle=clamp_angle,
        scale_error=view.scale.relative_error,
        roll_error=view.roll_error,
    )
    return bending, thread


def measure_centerline(
    points: Floats,
    thickness: float,
    *,
    clamp_angle: float | None = None,
    scale_error: float = 0.0,
    roll_error: float = 0.0,
) -> Bending:
    """Measure a thread by its centreline.

    Three uniform rods are fitted: to the thread, to what follows its first thickness, and to the
    thread in a camera that rolls. A part of a hanging rod hangs as a rod with another clamp, so
    the first two have the same bending length, unless the edge of the ledge has bent the thread.
    The third matters for long threads: their lower part hangs along gravity, and a wrong direction
    of gravity reads as stiffness.

    Args:
        points: Points from the ledge to the free end, x away from the ledge and z up, (n, 2) [mm].
        thickness: Thickness of the thread [mm].
        clamp_angle: Angle by which the thread leaves the ledge upwards [rad]. None fits it.
        scale_error: Standard deviation of the scale over the scale [-].
        roll_error: Standard deviation of the camera's roll [rad].

    Raises:
        ValueError: The thickness is not > 0, or the thread leaves the ledge by over 45 degrees from
            level or from the given angle.
        RuntimeError: No rod near the centreline hangs in a stable equilibrium.
    """
    check_positive(thickness=thickness)
    centerline, length = _centerline(points)
    fit = _fit(centerline, clamp_angle)
    bending_length = _bending_length(fit.rod, length)
    natural_bend = fit.rod.phi1 / length

    rest, rest_length = _centerline(_without_start(points, thickness))
    rest_rod = fit_tilted_clamp(rest, phi0=0.0, clamp_frame=_clamp_near(rest)).rod
    rolled_rod = _fit(_centerline(points @ _turn(roll_error).T)[0], clamp_angle).rod

    # Each cause of error changes the bending length and the natural bend. The bending length falls
    # with the third root of gamma.
    residual = fit.rod.solution.centerline[0] - centerline
    widening = float(np.sqrt(correlation_length(residual)))
    gamma_error, _, bend_error = widening * fit.rod.standard_error
    change_at_ledge = _bending_length(rest_rod, rest_length) - bending_length
    change_by_roll = _bending_length(rolled_rod, length) - bending_length
    length_errors = (
        bending_length * gamma_error / (3.0 * fit.rod.gamma),
        bending_length * scale_error,
        change_at_ledge,
        change_by_roll,
    )
    bend_errors = (
        bend_error / length,
        rest_rod.phi1 / rest_length - natural_bend,
        rolled_rod.phi1 / length - natural_bend,
    )
    return Bending(
        length=length,
        bending_length=bending_length,
        bending_length_error=float(np.linalg.norm(length_errors)),
        natural_bend=1e3 * natural_bend,
        natural_bend_error=1e3 * float(np.linalg.norm(bend_errors)),
        clamp_angle=fit.tilt,
        clamp_angle_error=widening * fit.tilt_error,
        residual=length * fit.rod.residual,
        change_at_ledge=change_at_ledge,
        change_by_roll=change_by_roll,
        trades_bend_for_weight=fit.rod.trades_bend_for_weight,
        fitted=length * fit.rod.solution.centerline[0][:, [0, 2]],
    )


def joint_bending(measured: Sequence[Bending]) -> JointBending:
    """Return the bending length of several photographs of the same yarn [Birge 1932].

    Raises:
        ValueError: There are fewer than two photographs.
    """
    if len(measured) < 2:
        raise ValueError(f"measured: must be two photographs or more, got {len(measured)}")
    lengths = np.array([bending.bending_length for bending in measured])
    weights = np.array([bending.bending_length_error for bending in measured]) ** -2.0
    mean = float((weights * lengths).sum() / weights.sum())
    # The square of the Birge ratio is 1 if the errors explain the scatter.
    birge = float((weights * (lengths - mean) ** 2).sum()) / (len(lengths) - 1)
    error = float(np.sqrt(max(birge, 1.0) / weights.sum()))
    return JointBending(mean, error, float(lengths.std(ddof=1)))


def correlation_length(residual: Floats) -> float:
    """Return how many points of a residual (P, 3) have one independent error together.

    It is 1 + 2 (r_1 + r_2 + ...) with the autocorrelation r_k at a distance of k points, up to the
    first that is negative [Priestley 1981, section 5.3].
    """
    # The first point is clamped and has no error.
    errors = residual[1:]
    variance = (errors**2).sum()
    total = 1.0
    for distance in range(1, len(errors)):
        correlation = (errors[distance:] * errors[:-distance]).sum() / variance
        if correlation < 0.0:
            break
        total += 2.0 * float(correlation)
    return total


def pixels_of(points: Floats, thread: Thread, view: View) -> Floats:
    """Return where points of the plane of a thread (n, 2) [mm] are in its photograph: [px]."""
    mirrored = points * [view.side, -1.0] * view.scale.pixels_per_mm
    return np.asarray(mirrored @ _turn(view.roll).T + thread.points[0])


def _in_millimetres(points: Floats, view: View) -> Floats:
    """Return pixels (n, 2) as points with x away from the ledge and z up [mm]."""
    level = (points - points[0]) @ _turn(view.roll)
    return np.asarray(level * [view.side, -1.0] / view.scale.pixels_per_mm)


def _turn(angle: float) -> Floats:
    """Return the matrix of a turn from x to y (2, 2)."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return np.array([[cosine, -sine], [sine, cosine]])


def _fit(centerline: Floats, clamp_angle: float | None) -> TiltedFit:
    """Fit a rod to a plane centreline (P, 3) [L]. A photograph does not show twist."""
    if clamp_angle is None:
        return fit_tilted_clamp(centerline, phi0=0.0, clamp_frame=LEVEL)
    frame = tilted_frame(LEVEL, clamp_angle)
    rod: ParameterFit = fit_parameters(centerline, phi0=0.0, clamp_frame=frame)
    return TiltedFit(rod, clamp_angle, 0.0, frame)


def _clamp_near(centerline: Floats) -> Floats:
    """Return a clamp (3, 3) near the direction in which a centreline (P, 3) begins."""
    direction, _ = leaving_direction(centerline)
    elevation = np.arctan2(direction[2], direction[0])
    steps = np.clip(np.round(elevation / CLAMP_STEP), -STEEPEST, STEEPEST)
    return tilted_frame(LEVEL, float(steps * CLAMP_STEP))


def _bending_length(rod: ParameterFit, length: float) -> float:
    """Return L / gamma^(1/3) of a rod, in the unit of its length L."""
    return float(length / rod.gamma ** (1.0 / 3.0))


def _centerline(points: Floats) -> tuple[Floats, float]:
    """Return a centreline (P, 3) [L] from points (n, 2) [mm], and its length L [mm]."""
    length = float(np.hypot(*np.diff(points, axis=0).T).sum())
    x, z = (uniform_points(points, POINTS) - points[0]).T / length
    return np.stack([x, np.zeros(POINTS), z], axis=1), length


def _without_start(points: Floats, distance: float) -> Floats:
    """Return a polygon (n, 2) without the first part of a length."""
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    start = [np.interp(distance, arc, column) for column in points.T]
    return np.concatenate([[start], points[arc > distance]])
