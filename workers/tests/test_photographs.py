"""Requests of `stickslip rods measure` become results in JSON."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from stickslip_sim_core import solve_general_rods
from stickslip_sim_core.photographs.bending import LEVEL
from stickslip_workers.__main__ import main


def request(photograph: Path, **options: Any) -> str:
    defaults = {
        "photographs": [str(photograph)],
        "ledges": [[100.0, 80.0]],
        "rulers": None,
        "ruler_mm": 100.0,
        "pixels_per_mm": None,
        "mark_mm": 1.0,
        "side": "right",
        "level": None,
        "clamp_degrees": None,
        "out": str(photograph.parent / "out"),
    }
    return json.dumps({**defaults, **options})


@pytest.fixture(scope="module")
def photograph(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A thread of 100 mm with gamma 125, so with a bending length of 20 mm, and no ruler."""
    rod = solve_general_rods(np.zeros((1, 1, 3)), np.array([125.0]), clamp_frame=LEVEL, points=201)
    pixels = rod.centerline[0][:, [0, 2]] * [400.0, -400.0] + [100.0, 80.0]
    picture = np.full((600, 500, 3), 60, np.uint8)
    line = np.round(pixels * 256).astype(np.int32)
    cv2.polylines(picture, [line], False, (210, 210, 210), 5, cv2.LINE_AA, 8)
    path = tmp_path_factory.mktemp("photographs") / "yarn.png"
    cv2.imwrite(str(path), picture)
    return path


def test_a_photograph_is_measured(photograph: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = {"rulers": [[0.0, 500.0, 400.0, 500.0]], "level": [0.0, 80.0, 100.0, 80.0]}
    assert main(["rods", request(photograph, **options)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["joint"] is None
    [measured] = answer["photographs"]
    assert measured["bending_length_mm"] == pytest.approx(20.0, rel=0.02)
    assert measured["length_mm"] == pytest.approx(100.0, rel=0.01)
    assert Path(measured["picture"]).is_file()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "yarn.png: ruler: the photograph must show the marks of a ruler"),
        ({"pixels_per_mm": 4.0, "level": [5.0, 1.0, 5.0, 9.0]}, "yarn.png: level: must be two"),
        ({"pixels_per_mm": 4.0, "clamp_degrees": 80.0}, "must leave the clamp within 45 degrees"),
    ],
)
def test_a_photograph_that_cannot_be_measured_is_refused(
    photograph: Path, options: dict[str, Any], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["rods", request(photograph, **options)]) == 2
    assert message in capsys.readouterr().err
