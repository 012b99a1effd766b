"""Finds the boards in frames."""

import numpy as np

from stickslip_training.arrays import Array, Floats
from stickslip_training.film.alignment import Print
from stickslip_training.film.boards import BOARDS, Sight, dictionary

MARKERS_MIN = 3
"""Fewest markers of a board in a frame that is measured: two may lie in one line."""
CORNER_WINDOW = 5
CORNER_SHARE = 0.6
"""Half of the window in which a corner is searched for: the lesser of these [px], and of this share
of a cell. Smaller ones see noise of lossy films, and larger ones other corners."""


class Finder:
    """Finds boards in frames."""

    def __init__(self) -> None:
        import cv2

        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.cornerRefinementWinSize = CORNER_WINDOW
        # OpenCV spells its name like this.
        parameters.relativeCornerRefinmentWinSize = CORNER_SHARE
        self._prints = {board.name: Print(board) for board in BOARDS}
        self._detector = cv2.aruco.ArucoDetector(dictionary(), parameters)

    def find(self, picture: Array) -> dict[str, Sight]:
        """Return the boards of a picture, grey levels (H, W), by name.

        A board with fewer than `MARKERS_MIN` markers is left out.
        """
        corners, numbers, _ = self._detector.detectMarkers(picture)
        quads: dict[int, Floats] = {
            int(number): np.asarray(quad, dtype=np.float64).reshape(4, 2)
            for number, quad in zip(
                np.ravel(numbers if numbers is not None else []), corners, strict=True
            )
        }
        sights = {}
        for board in BOARDS:
            visible = {number: quads[number] for number in board.numbers if number in quads}
            if len(visible) >= MARKERS_MIN:
                sights[board.name] = self._prints[board.name].aligned(picture, visible)
        return sights
