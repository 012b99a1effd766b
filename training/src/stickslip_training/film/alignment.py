"""Where a frame has the parts of a board's print, to a few hundredths of a pixel.

The search for markers places a corner of a black square up to 0.3 px inside of it, because blur
rounds the corner off. Such errors are alike in all frames, and turn a board by 0.2 degrees. So each
quarter of a marker, with its edges and cells, is laid over the frame as a whole [Lucas and Kanade
1981]: blur moves opposite edges by opposite amounts, and the place of the quarter stays.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip_training.arrays import Array, Floats, SingleFloats
from stickslip_training.film.boards import CELLS, MARKER, SIZE, Board, Sight, marker_cells

DOT = 1e-3
"""Side of a pixel of the print [m]: about that of a frame that shows both boards and a tray."""
FINE = 8
"""Pixels in a pixel of the print, along a side, that cells are drawn with, and at most those that a
frame is read with: edges between pixels of the print are grey."""
BLUR = 0.8
"""Standard deviation of the blur of the print [px]: about that of a film. Twice as much changes the
tilt by 0.02 degrees."""
WHITE = 0.005
"""White paper about a marker that counts to its quarters [m]: less than half of a gap."""
MARGIN = 0.008
"""White paper about the board [m]: that of its quarters, and what blur takes from beyond."""
ROUNDS = 2
"""Rounds of the alignment: a third one changes the tilt by 0.005 degrees."""
FARTHEST = 0.003
"""Longest way of a quarter in a round [m]: a third of a cell, beyond which it meets other edges."""
CONTRAST_MIN = 5.0
"""Least difference of white and black, of 255, at which a quarter is moved."""


@dataclass(frozen=True)
class Quarter:
    """A quarter of a marker, with white paper on two sides."""

    window: tuple[slice, slice]
    """Rows and columns of the print."""
    middle: Floats
    """On the board, (2,) [m]."""
    solution: Floats
    """Turns grey levels of the window, (N,), into (3,): the slopes of levels that the shift to the
    right and up explain, and the contrast."""

    def shift(self, view: Array) -> Floats:
        """Return how far the quarter is off its place in a view of the board, (2,) [m]."""
        right, up, contrast = self.solution @ view[self.window].ravel()
        if contrast < CONTRAST_MIN:
            return np.zeros(2)
        way = -np.array([right, up]) / contrast
        return np.asarray(way * min(1.0, FARTHEST / max(1e-12, float(np.hypot(*way)))))


class Print:
    """The print of a board, which is laid over frames."""

    def __init__(self, board: Board) -> None:
        """Draw the board."""
        self._quarters = _quarters(board, _drawn(board))

    def aligned(self, picture: Array, corners: dict[int, Floats]) -> Sight:
        """Return where a picture, grey levels (H, W), has the quarters of markers.

        `corners` (4, 2) [px] of each visible marker tell about where they are.
        """
        import cv2

        quarters = [quarter for number in corners for quarter in self._quarters[number][1]]
        middles = np.array([quarter.middle for quarter in quarters])
        points = np.concatenate([self._quarters[number][0] for number in corners])
        pixels = np.concatenate([corners[number] for number in corners])
        for _ in range(ROUNDS):
            # A board is small, so that a lens bends it by parts of a pixel, which shifts take up.
            plane: Any = cv2.findHomography(points, pixels)[0]
            view = _view(picture, plane, _longest_side(corners))
            shifts = np.array([quarter.shift(view) for quarter in quarters])
            points = middles
            pixels = cv2.perspectiveTransform((middles + shifts)[None], plane)[0]
        return Sight(points, np.asarray(pixels, dtype=np.float64))


def _shape() -> tuple[int, int]:
    """Return height and width of a print [px]."""
    return round((SIZE[1] + 2 * MARGIN) / DOT), round((SIZE[0] + 2 * MARGIN) / DOT)


def _longest_side(corners: dict[int, Floats]) -> float:
    """Return the length of the longest side of markers, (4, 2) [px] each, in a picture [px]."""
    sides = [np.hypot(*(quad - np.roll(quad, 1, axis=0)).T) for quad in corners.values()]
    return float(np.max(sides))


def _view(picture: Array, plane: Floats, side: float) -> SingleFloats:
    """Return a board in a picture as a print, (H, W).

    Args:
        picture: Grey levels (H, W).
        plane: Takes places on the board [m] to the picture [px], (3, 3).
        side: Longest side of a marker in the picture [px].
    """
    import cv2

    height, width = _shape()
    # Each pixel of a sharper picture counts, so that edges are seen between pixels of the print.
    parts = min(FINE, max(1, math.ceil(side / (MARKER / DOT))))
    dot = DOT / parts
    corner = (-SIZE[0] / 2 - MARGIN + dot / 2, SIZE[1] / 2 + MARGIN - dot / 2)
    to_board = np.array([[dot, 0.0, corner[0]], [0.0, -dot, corner[1]], [0.0, 0.0, 1.0]])
    fine = cv2.warpPerspective(
        picture,
        plane @ to_board,
        (width * parts, height * parts),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float32)
    return np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _places() -> Floats:
    """Return the places of the pixels of a print on its board, (H, W, 2) [m]."""
    rows, columns = _shape()
    right = (np.arange(columns) - (columns - 1) / 2) * DOT
    up = ((rows - 1) / 2 - np.arange(rows)) * DOT
    return np.stack(np.meshgrid(right, up), axis=-1)


def _drawn(board: Board) -> Floats:
    """Return the print of a board, (H, W): 0 is black and 1 is white."""
    import cv2

    height, width = _shape()
    fine = np.ones((height * FINE, width * FINE), dtype=np.float32)
    cell = round(MARKER / CELLS / DOT * FINE)
    corner = np.array([-SIZE[0] / 2 - MARGIN, SIZE[1] / 2 + MARGIN])
    for number, quad in zip(board.numbers, board.corners, strict=True):
        left, down = np.round(np.abs(quad[0] - corner) / DOT * FINE).astype(int)
        cells = np.kron(marker_cells(number), np.ones((cell, cell)))
        fine[down : down + len(cells), left : left + len(cells)] = cells
    drawn = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.GaussianBlur(drawn, (0, 0), BLUR), dtype=np.float64)


def _quarters(board: Board, drawn: Floats) -> dict[int, tuple[Floats, list[Quarter]]]:
    """Return the corners (4, 2) [m] and the quarters of each marker of a board."""
    places = _places()
    down, right = np.gradient(drawn, DOT)
    parts = np.stack([right, -down, drawn, np.ones_like(drawn)], axis=-1)
    markers = {}
    for number, quad in zip(board.numbers, board.corners, strict=True):
        quarters = []
        for corner in quad:
            middle = quad.mean(axis=0)
            outer = corner + WHITE * np.sign(corner - middle)
            low, high = np.minimum(middle, outer), np.maximum(middle, outer)
            inside = ((places > low) & (places < high)).all(axis=-1)
            rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
            window = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
            quarters.append(_quarter(window, parts[window], places[window]))
        markers[number] = (quad, quarters)
    return markers


def _quarter(window: tuple[slice, slice], parts: Floats, places: Floats) -> Quarter:
    """Return a quarter: least squares of slopes, print, level, and light that changes across."""
    middle = places.reshape(-1, 2).mean(axis=0)
    columns = np.concatenate([parts, places - middle], axis=-1).reshape(-1, 6)
    sizes = np.abs(columns).max(axis=0)
    solution = np.linalg.pinv(columns / sizes) / sizes[:, None]
    return Quarter(window, middle, solution[:3])
