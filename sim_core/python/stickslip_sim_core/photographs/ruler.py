"""The scale of a photograph: from two points of a ruler, or from its periodic marks."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats, check_positive

Picture = NDArray[np.uint8]
Pixel = tuple[float, float]

CLICK_ERROR = 1.0
"""Standard deviation of a coordinate that a person reads off a photograph [px]."""

BAND_HEIGHT = 12
"""Height of the bands in which marks are searched [px]: less than marks are long."""

BAND_LENGTH = 384
"""Length of the bands [px]. A ruler that lies askew by 2 degrees leaves a band of this length by
13 px, which is about its height.
"""

LEAST_SPACING = 4
"""Least distance of two marks [px]; closer ones are not resolved."""

LEAST_MARKS = 15
"""Least number of marks in a band: fewer repetitions may be chance."""

LIGHT_WINDOW = 61
"""Length of the mean that is subtracted from a band [px]: more than two marks of the longest
distance, so that it removes light and no marks.
"""

LEAST_CORRELATION = 0.5
"""Least correlation of a band with itself, shifted by a mark: half of its contrast is periodic."""

AGREEING_BANDS = 3
"""Bands that must give the same distance of marks. Marks are longer than a band is high."""

SPACING_TOLERANCE = 0.03
"""Relative difference of the distances of marks in bands that agree."""


@dataclass(frozen=True)
class Scale:
    """Pixels per millimetre in the plane of the thread."""

    pixels_per_mm: float
    """[px/mm]."""

    relative_error: float
    """Standard deviation of the scale over the scale [-]."""


def scale_of_points(first: Pixel, second: Pixel, distance: float) -> Scale:
    """Return the scale from two points of a ruler that are a distance [mm] apart.

    Raises:
        ValueError: The points are equal, or the distance is not > 0.
    """
    check_positive(distance=distance)
    pixels = float(np.hypot(second[0] - first[0], second[1] - first[1]))
    if pixels == 0.0:
        raise ValueError(f"ruler: must be two different points, and both are {first} [px]")
    return Scale(pixels / distance, float(np.sqrt(2.0)) * CLICK_ERROR / pixels)


def scale_of_marks(picture: Picture, spacing: float) -> Scale:
    """Return the scale from the marks of a ruler that lies level or upright in a photograph.

    A band across the marks is periodic. Bands that touch only the longer marks of 5 or 10 mm have a
    longer period, so the shortest period that several bands agree on is that of the finest marks.

    Args:
        picture: The photograph, (H, W, 3).
        spacing: Distance of the finest marks [mm].

    Raises:
        ValueError: The photograph shows no periodic marks, or `spacing` is not > 0.
    """
    check_positive(spacing=spacing)
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY).astype(np.float64)
    level = _periods(grey)
    upright = _periods(grey.T)
    periods = np.sort(np.concatenate([level, upright]))
    for period in periods:
        agreeing = periods[np.abs(periods / period - 1.0) <= SPACING_TOLERANCE]
        if len(agreeing) >= AGREEING_BANDS:
            mean = float(np.median(agreeing))
            deviation = float(np.std(agreeing)) / np.sqrt(len(agreeing))
            return Scale(mean / spacing, deviation / mean)
    raise ValueError(
        "ruler: the photograph must show the marks of a ruler, level or upright, at least "
        f"{LEAST_SPACING} pixels apart, and no such marks were found; lay a ruler beside the "
        "thread and photograph again, or give two points of a ruler and their distance"
    )


def _periods(grey: Floats) -> Floats:
    """Return the periods [px] of all periodic bands of a picture, along its rows: (n,)."""
    height, width = grey.shape
    length = min(BAND_LENGTH, width)
    rows = height // BAND_HEIGHT
    bands = grey[: rows * BAND_HEIGHT].reshape(rows, BAND_HEIGHT, width).mean(axis=1)
    starts = range(0, width - length + 1, max(length // 2, 1))
    profiles = np.concatenate([bands[:, start : start + length] for start in starts])
    # Light that changes along the band is no mark.
    smooth = cv2.blur(profiles, (LIGHT_WINDOW, 1), borderType=cv2.BORDER_REFLECT)
    return np.array([p for p in map(_period, profiles - smooth) if p is not None])


def _period(profile: Floats) -> float | None:
    """Return the period of a profile (n,) [px], or None if it is not periodic."""
    count = len(profile)
    power = np.abs(np.fft.rfft(profile, 2 * count)) ** 2
    overlap = np.arange(count, 0, -1)
    correlation = np.fft.irfft(power)[:count] / overlap
    # A flat band has no contrast; a grey level is the least difference in a photograph.
    if correlation[0] < 1.0:
        return None
    correlation = correlation / correlation[0]
    lags = np.arange(LEAST_SPACING, count // LEAST_MARKS + 1)
    inner = correlation[lags]
    is_peak = (inner >= correlation[lags - 1]) & (inner > correlation[lags + 1])
    peaks = lags[is_peak & (inner >= LEAST_CORRELATION)]
    if len(peaks) == 0:
        return None
    return _refined_period(correlation, int(peaks[0]))


def _refined_period(correlation: Floats, lag: int) -> float | None:
    """Return a period [px] from the last peak of the correlation that is a multiple of a lag.

    The tenth repetition places the period ten times as exactly as the first.
    """
    period = float(lag)
    for repetition in range(1, LEAST_MARKS // 2 + 1):
        near = round(repetition * period)
        window = np.arange(near - 1, near + 2)
        if window[-1] >= len(correlation) - 1:
            break
        peak = int(window[np.argmax(correlation[window])])
        left, middle, right = correlation[peak - 1 : peak + 2]
        bend = left - 2.0 * middle + right
        is_peak = middle >= left and middle >= right and bend < 0.0
        # A ruler shows all of its marks: the tenth is as clear as the first.
        if not is_peak or middle < LEAST_CORRELATION:
            return None
        # A parabola through the three points has its top between them.
        period = (peak + 0.5 * (left - right) / bend) / repetition
    return period
