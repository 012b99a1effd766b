"""The two boards of markers that a film is measured by.

A board is 2 rows of 3 square ArUco markers. One lies on the level table, one on the tray. Axes of a
board begin in its middle: x to the right of the print, y to its upper edge, z out of the paper.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from stickslip_training.arrays import Array, Floats

if TYPE_CHECKING:
    import cv2

MARKER = 0.048
"""Side of a marker [m]: its cells are 8 mm wide, which lossy films keep."""
GAP = 0.012
"""Distance between two markers [m]: white paper of 1.5 cells, which the search for corners needs.
"""
COLUMNS = 3
ROWS = 2
CELLS = 6
"""Cells along a side of a marker, its black frame included."""


@dataclass(frozen=True)
class Board:
    """A board of markers."""

    name: str
    first: int
    """Number of its first marker in the dictionary; the others follow by rows."""

    @property
    def numbers(self) -> range:
        """Return the numbers of its markers."""
        return range(self.first, self.first + ROWS * COLUMNS)

    @property
    def corners(self) -> Floats:
        """Return the corners of its markers, (6, 4, 2) [m]: clockwise from the upper left one."""
        step = MARKER + GAP
        left = (np.arange(COLUMNS) - (COLUMNS - 1) / 2) * step - MARKER / 2
        upper = ((ROWS - 1) / 2 - np.arange(ROWS)) * step + MARKER / 2
        starts = np.stack(np.meshgrid(left, upper), axis=-1).reshape(-1, 1, 2)
        square = MARKER * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, -1.0], [0.0, -1.0]])
        return np.asarray(starts + square)


TABLE = Board("table", 0)
TRAY = Board("tray", 6)
BOARDS = (TABLE, TRAY)
SIZE = (COLUMNS * (MARKER + GAP) - GAP, ROWS * (MARKER + GAP) - GAP)
"""Width and height of a board [m]."""


@dataclass(frozen=True)
class Sight:
    """Where a frame has points of a board."""

    points: Floats
    """On the board, (N, 2) [m]: the middles of the quarters of its visible markers."""
    pixels: Floats
    """In the frame, (N, 2) [px]: the middle of the first pixel is (0, 0)."""


def dictionary() -> "cv2.aruco.Dictionary":
    """Return the dictionary of the markers: few bits, so that cells are large."""
    import cv2

    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


def marker_cells(number: int) -> Array:
    """Return the cells of a marker, (6, 6), True where they are white."""
    import cv2

    picture: Any = cv2.aruco.generateImageMarker(dictionary(), number, CELLS)
    return np.asarray(picture > 0)
