"""Photographs of threads that tests draw: the truth is known."""

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from stickslip_sim_core import solve_general_rods
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.photographs.bending import LEVEL
from stickslip_sim_core.photographs.ruler import Picture, Pixel

PIXELS_PER_MM = 4.0
LENGTH_MM = 150.0
THICKNESS_MM = 2.0
SIZE = (800, 1000)
LEDGE = (200.0, 130.0)
SUBPIXEL = 256


class Photograph(NamedTuple):
    """A drawn photograph."""

    picture: Picture
    ledge: Pixel


Draw = Callable[..., Photograph]


def _places(points: Floats) -> Floats:
    """Return pixels in the fractions of OpenCV's drawing."""
    return np.round(points * SUBPIXEL).astype(np.int32)


def _ruler(picture: Picture, corner: tuple[int, int], marks: int) -> None:
    """Draw a ruler with a mark for each millimetre; the fifth and tenth are longer."""
    x, y = corner
    right = x + round(marks * PIXELS_PER_MM)
    cv2.rectangle(picture, (x - 8, y - 8), (right + 8, y + 70), (190, 230, 240), -1)
    for number in range(marks + 1):
        height = 48 if number % 10 == 0 else 38 if number % 5 == 0 else 26
        along = x + number * PIXELS_PER_MM
        ends = np.array([[along, y], [along, y + height]])
        cv2.polylines(picture, [_places(ends)], False, (20, 20, 20), 1, cv2.LINE_AA, 8)


def _thread(gamma: float, bend: float, roll: float) -> Floats:
    """Return the pixels of a hung thread in a camera that rolls by an angle [degrees]."""
    rod = solve_general_rods(
        np.array([[[0.0, 0.0, bend]]]), np.array([gamma]), clamp_frame=LEVEL, points=401
    ).centerline[0]
    angle = np.radians(roll)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(rod[:, [0, 2]] * [1.0, -1.0] * LENGTH_MM * PIXELS_PER_MM @ turn.T + LEDGE)


@pytest.fixture(scope="session")
def draw() -> Draw:
    def draw_photograph(
        gamma: float,
        bend: float,
        *,
        roll: float = 0.0,
        seed: int = 0,
        has_ruler: bool = True,
        is_mirrored: bool = False,
    ) -> Photograph:
        generator = np.random.default_rng(seed)
        height, width = SIZE
        stains = cv2.resize(generator.normal(scale=6.0, size=(12, 15)), (width, height))
        light = np.linspace(40.0, 80.0, width) + stains
        picture = np.repeat(light[..., None], 3, axis=2).astype(np.uint8)
        ground = picture.copy()
        pixels = _thread(gamma, bend, roll)

        x, y = round(LEDGE[0]), round(LEDGE[1] + 5)
        cv2.rectangle(picture, (0, y), (x, height), (40, 90, 140), -1)
        line = _places(np.concatenate([[[0.0, LEDGE[1]]], pixels]))
        thickness = round(THICKNESS_MM * PIXELS_PER_MM)
        cv2.polylines(picture, [line], False, (200, 210, 215), thickness, cv2.LINE_AA, 8)
        # OpenCV draws round ends, and the thread is cut square.
        along = pixels[-1] - pixels[-3]
        along *= thickness / np.linalg.norm(along)
        across = np.array([-along[1], along[0]])
        corners = pixels[-1] + [across, -across, along - across, along + across]
        beyond = np.zeros(SIZE, np.uint8)
        cv2.fillPoly(beyond, [_places(corners)], 255, cv2.LINE_AA, 8)
        picture = np.where(beyond[..., None] > 127, ground, picture)
        if has_ruler:
            _ruler(picture, (560, 690), 100)

        blurred = cv2.GaussianBlur(picture, (0, 0), 1.0)
        noisy = blurred + generator.normal(scale=5.0, size=picture.shape)
        picture = np.clip(noisy, 0, 255).astype(np.uint8)
        if is_mirrored:
            return Photograph(np.ascontiguousarray(picture[:, ::-1]), (width - 1 - x, LEDGE[1]))
        return Photograph(picture, LEDGE)

    return draw_photograph
