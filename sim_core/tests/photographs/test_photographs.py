"""Threads and rulers in drawn photographs, and photographs that are refused."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from stickslip_sim_core.photographs.bending import View, measure_thread
from stickslip_sim_core.photographs.overlay import read_photograph, write_overlay
from stickslip_sim_core.photographs.ruler import scale_of_marks, scale_of_points
from stickslip_sim_core.photographs.thread import find_thread

Draw = Callable[..., Any]


def test_marks_give_the_scale(draw: Draw) -> None:
    picture = draw(100.0, 0.0).picture
    scale = scale_of_marks(picture, 1.0)
    assert scale.pixels_per_mm == pytest.approx(4.0, rel=3e-3)
    upright = np.ascontiguousarray(picture.transpose(1, 0, 2))
    assert scale_of_marks(upright, 1.0).pixels_per_mm == pytest.approx(4.0, rel=3e-3)
    assert scale_of_marks(picture, 0.5).pixels_per_mm == pytest.approx(8.0, rel=3e-3)


def test_a_photograph_without_a_ruler_is_refused(draw: Draw) -> None:
    with pytest.raises(ValueError, match=r"ruler: .* lay a ruler beside the thread .* or give two"):
        scale_of_marks(draw(100.0, 0.0, has_ruler=False).picture, 1.0)


def test_two_points_give_the_scale_and_its_error() -> None:
    scale = scale_of_points((10.0, 10.0), (310.0, 410.0), 100.0)
    assert scale.pixels_per_mm == pytest.approx(5.0)
    assert scale.relative_error == pytest.approx(np.sqrt(2.0) / 500.0)
    with pytest.raises(ValueError, match="two different points"):
        scale_of_points((1.0, 1.0), (1.0, 1.0), 100.0)
    with pytest.raises(ValueError, match="distance: must be finite and > 0, got 0"):
        scale_of_points((1.0, 1.0), (2.0, 1.0), 0.0)


def test_the_thickness_is_that_of_the_thread(draw: Draw) -> None:
    photograph = draw(100.0, 0.0)
    assert find_thread(photograph.picture, photograph.ledge, 1).thickness == pytest.approx(8, abs=2)


@pytest.mark.parametrize(
    ("ledge", "message"),
    [
        ((700.0, 400.0), r"stand out from its background .* at \(700.0, 400.0\)"),
        ((-1.0, 130.0), r"ledge: must be a pixel of the photograph"),
        ((200.0, 900.0), r"y in 0 ... 799, and it is \(200.0, 900.0\)"),
    ],
)
def test_a_ledge_without_a_thread_is_refused(
    draw: Draw, ledge: tuple[float, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        find_thread(draw(100.0, 0.0).picture, ledge, 1)


def test_what_touches_the_thread_is_refused(draw: Draw) -> None:
    photograph = draw(100.0, 0.0)
    picture = photograph.picture.copy()
    points = find_thread(picture, photograph.ledge, 1).points
    # A pale card of the colour of the thread, half behind it.
    x, y = points[len(points) // 2].astype(int).tolist()
    cv2.rectangle(picture, (x, y - 125), (x + 22, y + 125), (200, 210, 215), -1)
    with pytest.raises(ValueError, match=r"nothing may touch the thread .* times the area"):
        find_thread(picture, photograph.ledge, 1)


def test_a_short_end_is_refused(draw: Draw) -> None:
    photograph = draw(100.0, 0.0)
    picture = photograph.picture.copy()
    picture[160:] = 60
    with pytest.raises(ValueError, match=r"at least 20 times as long as thick"):
        find_thread(picture, photograph.ledge, 1)


def test_the_overlay_is_drawn_along_the_thread(draw: Draw, tmp_path: Path) -> None:
    photograph = draw(100.0, 0.0)
    view = View(photograph.ledge, scale_of_points((0.0, 0.0), (400.0, 0.0), 100.0))
    bending, thread = measure_thread(photograph.picture, view)
    path = tmp_path / "overlay.png"
    write_overlay(path, photograph.picture, bending, thread, view)
    drawn = read_photograph(path)
    is_red = (drawn[..., 2] > 200) & (drawn[..., 1] < 80) & (drawn[..., 0] < 80)
    assert is_red.sum() > 300
    rows, columns = np.nonzero(is_red)
    nearest = [np.hypot(*(thread.points - place).T).min() for place in np.c_[columns, rows]]
    assert max(nearest) < 3.0


def test_a_file_that_is_no_picture_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.jpg"
    path.write_text("no picture")
    with pytest.raises(
        ValueError, match=r"must be a picture, such as JPEG or PNG, and .*notes.jpg"
    ):
        read_photograph(path)
