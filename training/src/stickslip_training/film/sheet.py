"""The sheet of markers for a printer: A4, at true size, with a bar to check the print."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from stickslip_schemas.installation import install_hint

from stickslip_training.film.boards import CELLS, MARKER, TABLE, TRAY, Board, marker_cells

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PAGE = (0.210, 0.297)
"""Width and height of A4 [m]."""
INCH = 0.0254
"""[m]"""
BAR = 0.100
"""Length of the bar that checks the print [m]."""
MM = 1e-3

NOTES = {
    TABLE.name: "TABLE: cut along the line, and lay this half on the level table beside the tray.",
    TRAY.name: "TRAY: tape this half flat on the tray, this edge towards the cloth.",
}
"""The line below each board."""
RULE = (
    "The bar is 100 mm long. The tilt does not depend on the size of the print, and a drag does: "
    'print at "actual size".'
)


def write_sheet(path: Path) -> None:
    """Write the sheet as PDF; raise ValueError if its name has another ending."""
    if path.suffix.lower() != ".pdf":
        raise ValueError(f"out: must be a file whose name ends with .pdf, and is {path}")
    figure = sheet()
    path.parent.mkdir(parents=True, exist_ok=True)
    # Without a date, equal sheets are equal files.
    figure.savefig(path, format="pdf", metadata={"CreationDate": None})


def sheet() -> "Figure":
    """Return the sheet: the board of the tray on its upper half, and that of the table below.

    Raises:
        ValueError: Matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ValueError(
            "the sheet needs matplotlib: " + install_hint("stickslip-training", "film")
        ) from error
    figure = Figure(figsize=(PAGE[0] / INCH, PAGE[1] / INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_xlim(0.0, PAGE[0])
    axes.set_ylim(0.0, PAGE[1])
    for board, middle in ((TRAY, 0.75 * PAGE[1]), (TABLE, 0.25 * PAGE[1])):
        _draw_board(axes, board, middle)
    axes.plot([0.0, PAGE[0]], [PAGE[1] / 2] * 2, color="0.6", linewidth=0.5, linestyle="--")
    _draw_bar(axes)
    return figure


def _draw_board(axes: "Axes", board: Board, middle: float) -> None:
    """Draw a board with its middle at a height [m]."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    origin = np.array([PAGE[0] / 2, middle])
    cell = MARKER / CELLS
    black = []
    for number, corners in zip(board.numbers, board.corners, strict=True):
        left, upper = corners[0] + origin
        for row, column in np.argwhere(~marker_cells(number)):
            place = (left + column * cell, upper - (row + 1) * cell)
            black.append(Rectangle(place, cell, cell))
    # Thin lines of the same black leave no gaps between cells.
    axes.add_collection(PatchCollection(black, facecolor="k", edgecolor="k", linewidth=0.05))
    axes.text(
        PAGE[0] / 2, middle - 60 * MM, NOTES[board.name], ha="center", va="center", fontsize=9
    )


def _draw_bar(axes: "Axes") -> None:
    """Draw the bar, with a mark at each 10 mm, along the lower edge, where printers still print."""
    from matplotlib.patches import Rectangle

    left, low = (PAGE[0] - BAR) / 2, 9.5 * MM
    for step in range(10):
        colour = "k" if step % 2 == 0 else "w"
        place = (left + step * BAR / 10, low)
        axes.add_patch(
            Rectangle(place, BAR / 10, 1.5 * MM, facecolor=colour, edgecolor="k", linewidth=0.3)
        )
    axes.text(PAGE[0] / 2, low - 2.5 * MM, RULE, ha="center", va="center", fontsize=6)
