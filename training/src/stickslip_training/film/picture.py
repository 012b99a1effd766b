"""The answer to a film as a picture: the frame at slip, tilt and offset over time, both mu."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stickslip_schemas.installation import install_hint

from stickslip_training.arrays import Array
from stickslip_training.film.boards import MARKER, Board
from stickslip_training.film.boards import TABLE as TABLE_BOARD
from stickslip_training.film.boards import TRAY as TRAY_BOARD
from stickslip_training.film.drag import Drag
from stickslip_training.film.measuring import NORMAL_80, Film
from stickslip_training.film.poses import pose_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIZE = (11.0, 8.0)
"""Of the picture [inch], with 110 pixels each."""
AXIS_COLOURS = ("tab:red", "tab:green", "tab:blue")
"""Of the axes x, y and z of a board."""


def write_picture(path: Path, film: Film, drag: Drag) -> None:
    """Write the picture as PNG; raise ValueError if its name has another ending."""
    if path.suffix.lower() != ".png":
        raise ValueError(f"--picture: must be a file whose name ends with .png, and is {path}")
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as error:
        raise ValueError(
            "the picture needs matplotlib: " + install_hint("stickslip-training", "film")
        ) from error
    figure = Figure(figsize=SIZE, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.6, 1.0], width_ratios=[2.0, 1.0])
    _draw_frame(figure.add_subplot(grid[0, :]), film)
    times = figure.add_subplot(grid[1, 0])
    _draw_times(times, film)
    _draw_mu(figure.add_subplot(grid[1, 1]), film, drag)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, format="png")


def frame_at(path: Path, time: float) -> Array:
    """Return the first frame from a time [s] on, or the last one, (H, W, 3), red first."""
    import av

    picture: Any = None
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            picture = frame
            if frame.time is not None and frame.time >= time:
                break
    return np.asarray(picture.to_ndarray(format="rgb24"))


def _draw_frame(axes: "Axes", film: Film) -> None:
    """Draw the frame at slip, or the steepest one, with the axes of both boards."""
    tilts = film.tilts
    slip = film.slip
    time = tilts.times[int(np.argmax(tilts.angles))] if slip is None else slip.onset.time
    place = min(int(np.searchsorted(tilts.times, time)), len(tilts.times) - 1)
    instant = float(tilts.times[place])
    axes.imshow(frame_at(film.path, instant))
    axes.set_axis_off()
    for board in (TABLE_BOARD, TRAY_BOARD):
        _draw_axes(axes, film, place, board)
    event = "steepest tilt" if slip is None else "the cloth begins to slide"
    axes.set_title(f"{event}: {instant:.2f} s, {np.degrees(tilts.angles[place]):.1f} degrees")


def _draw_axes(axes: "Axes", film: Film, place: int, board: Board) -> None:
    """Draw corners and axes of a board in a frame."""
    frame = int(np.searchsorted(film.sightings.times, film.tilts.times[place]))
    sight = film.sightings.sights[frame][board.name]
    axes.plot(*sight.pixels.T, ".", color="yellow", markersize=2)
    ends = np.vstack([np.zeros(3), 1.5 * MARKER * np.eye(3)])
    pixels = pose_of(sight, film.lens).pixels(ends, film.lens)
    for end, colour in zip(pixels[1:], AXIS_COLOURS, strict=True):
        axes.plot(*np.stack([pixels[0], end]).T, color=colour, linewidth=2)


def _draw_times(axes: "Axes", film: Film) -> None:
    """Draw tilt and offset over time."""
    tilts = film.tilts
    axes.plot(tilts.times, np.degrees(tilts.angles), color="tab:blue", linewidth=1)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("tilt [degree]", color="tab:blue")
    slip = film.slip
    if slip is None:
        return
    sd = np.degrees(slip.sd)
    axes.errorbar(
        slip.onset.time, np.degrees(slip.tilt.angle), yerr=NORMAL_80 * sd, fmt="o", color="k"
    )
    offset = axes.twinx()
    slide = slip.slide
    offset.plot(slide.times, 1e3 * slide.offsets, ".", color="tab:red", markersize=4)
    offset.plot(slide.times, 1e3 * slip.onset.offsets(slide.times), color="tab:red", linewidth=1)
    offset.set_ylabel("offset of the cloth [mm]", color="tab:red")
    axes.set_xlim(0.0, min(tilts.times[-1], slip.onset.time + 3.0))


def _draw_mu(axes: "Axes", film: Film, drag: Drag) -> None:
    """Draw both answers with their 80 % intervals."""
    labels = []
    if film.slip is not None:
        low, high = film.slip.interval
        mu = film.slip.mu
        axes.errorbar(0, mu, yerr=[[mu - low], [high - mu]], fmt="o", color="tab:blue", capsize=4)
        labels.append(f"tilt, static\n{mu:.3f}\n({low:.3f} to {high:.3f})")
    elif film.motion.stayed:
        above = float(np.tan(film.steepest))
        axes.errorbar(0, above, yerr=0.05, lolims=True, fmt="_", color="tab:blue")
        labels.append(f"tilt, static\nabove {above:.2f}")
    else:
        labels.append("tilt, static\nno answer")
    if drag.mu is not None:
        mu, low, high = (float(drag.mu[name]) for name in ("median", "low", "high"))
        axes.errorbar(1, mu, yerr=[[mu - low], [high - mu]], fmt="s", color="tab:red", capsize=4)
        labels.append(f"drag, network\n{mu:.2f}\n({low:.2f} to {high:.2f})")
    else:
        labels.append("drag, network\nno answer")
    axes.set_xticks([0, 1], labels)
    axes.set_xlim(-0.6, 1.6)
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("mu, 80 % interval")
