"""Photographs as files: read, and drawn over with the measured thread."""

from pathlib import Path

import cv2
import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.photographs.bending import Bending, View, pixels_of
from stickslip_sim_core.photographs.ruler import Picture
from stickslip_sim_core.photographs.thread import Thread

SEEN_COLOUR = (60, 200, 60)
"""Blue, green and red of the centreline that was found."""

FITTED_COLOUR = (40, 40, 230)
"""Blue, green and red of the fitted rod."""

LINE_SHARE = 1.0 / 600.0
"""Width of lines over the shorter side of the picture."""

FRACTION_BITS = 4
"""Bits of the fractions of a pixel in OpenCV's drawing."""


def read_photograph(path: Path) -> Picture:
    """Read a photograph, upright as its camera says: blue, green and red, (H, W, 3).

    Raises:
        ValueError: The file is no picture.
        OSError: The file cannot be read.
    """
    picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError(f"photograph: must be a picture, such as JPEG or PNG, and {path} is not")
    return np.asarray(picture, np.uint8)


def write_overlay(
    path: Path, picture: Picture, bending: Bending, thread: Thread, view: View
) -> None:
    """Write a photograph with the centreline, the fitted rod and the result, as PNG."""
    drawn = picture.copy()
    width = max(round(LINE_SHARE * min(picture.shape[:2])), 1)
    _draw_line(drawn, thread.points, SEEN_COLOUR, 2 * width)
    _draw_line(drawn, pixels_of(bending.fitted, thread, view), FITTED_COLOUR, width)
    lines = (
        f"bending length {bending.bending_length:.1f} +- {bending.bending_length_error:.1f} mm",
        f"natural bend {bending.natural_bend:.1f} +- {bending.natural_bend_error:.1f} /m",
        f"length {bending.length:.1f} mm; green: found, red: fitted",
    )
    for number, line in enumerate(lines, 1):
        _write_line(drawn, line, number)
    path.write_bytes(cv2.imencode(".png", drawn)[1].tobytes())


def _draw_line(picture: Picture, points: Floats, colour: tuple[int, int, int], width: int) -> None:
    places = np.round(points * 2**FRACTION_BITS).astype(np.int32)
    cv2.polylines(picture, [places], False, colour, width, cv2.LINE_AA, FRACTION_BITS)


def _write_line(picture: Picture, text: str, number: int) -> None:
    """Write a line of text, white on black, which can be read on any photograph."""
    size = min(picture.shape[:2]) / 1000.0
    place = (round(20 * size), round(40 * size * number))
    for colour, extra in (((0, 0, 0), 4), ((255, 255, 255), 0)):
        width = max(round(2 * size) + extra, 1)
        cv2.putText(
            picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, width, cv2.LINE_AA
        )
