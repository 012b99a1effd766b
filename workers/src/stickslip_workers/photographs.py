"""Bending lengths of threads in photographs, for `stickslip rods measure`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stickslip_sim_core.photographs.bending import Bending, View, joint_bending, measure_thread
from stickslip_sim_core.photographs.overlay import read_photograph, write_overlay
from stickslip_sim_core.photographs.ruler import (
    CLICK_ERROR,
    Picture,
    Scale,
    scale_of_marks,
    scale_of_points,
)

SIDES = {"right": 1, "left": -1}

Answer = dict[str, Any]


def measure_photographs(request: Mapping[str, Any]) -> Answer:
    """Measure the photographs of a request, and return the result as JSON.

    Args:
        request: `photographs` (paths), `ledges` (a pixel for each), `rulers` (two pixels for each,
            or null), `ruler_mm`, `pixels_per_mm` (or null), `mark_mm`, `side`, `level` (two pixels
            or null), `clamp_degrees` (or null), and `out`, the directory for the pictures.

    Raises:
        ValueError: A value breaks its rule, or a photograph cannot be measured; the message begins
            with the photograph.
    """
    out = Path(request["out"])
    out.mkdir(parents=True, exist_ok=True)
    measured = []
    answers = []
    for number, name in enumerate(request["photographs"]):
        path = Path(name)
        try:
            bending, picture = _measure(path, number, request, out)
        except (ValueError, RuntimeError) as error:
            raise ValueError(f"{path.name}: {error}") from error
        measured.append(bending)
        answers.append({"photograph": name, **_as_json(bending), "picture": str(picture)})
    joint = joint_bending(measured) if len(measured) > 1 else None
    return {"photographs": answers, "joint": None if joint is None else vars(joint)}


def _measure(
    path: Path, number: int, request: Mapping[str, Any], out: Path
) -> tuple[Bending, Path]:
    """Measure a photograph, and draw over it."""
    picture = read_photograph(path)
    x, y = request["ledges"][number]
    view = View(
        ledge=(x, y),
        scale=_scale(picture, number, request),
        side=SIDES[request["side"]],
        **_roll(request["level"]),
    )
    degrees = request["clamp_degrees"]
    angle = None if degrees is None else float(np.radians(degrees))
    bending, thread = measure_thread(picture, view, clamp_angle=angle)
    overlay = out / f"{path.stem}-bending.png"
    write_overlay(overlay, picture, bending, thread, view)
    return bending, overlay


def _scale(picture: Picture, number: int, request: Mapping[str, Any]) -> Scale:
    """Return the scale that the request gives, or that of the ruler in the picture."""
    if request["pixels_per_mm"] is not None:
        return Scale(request["pixels_per_mm"], 0.0)
    if request["rulers"] is not None:
        x0, y0, x1, y1 = request["rulers"][number]
        return scale_of_points((x0, y0), (x1, y1), request["ruler_mm"])
    return scale_of_marks(picture, request["mark_mm"])


def _roll(level: list[float] | None) -> dict[str, float]:
    """Return the roll of the camera and its error [rad] by two pixels of a level line."""
    if level is None:
        return {}
    x0, y0, x1, y1 = level
    if x0 == x1:
        raise ValueError(f"level: must be two pixels of a level line, with another x, got {level}")
    distance = float(np.hypot(x1 - x0, y1 - y0))
    return {
        "roll": float(np.arctan((y1 - y0) / (x1 - x0))),
        "roll_error": float(np.sqrt(2.0)) * CLICK_ERROR / distance,
    }


def _as_json(bending: Bending) -> Answer:
    return {
        "length_mm": bending.length,
        "bending_length_mm": bending.bending_length,
        "bending_length_error_mm": bending.bending_length_error,
        "natural_bend_per_m": bending.natural_bend,
        "natural_bend_error_per_m": bending.natural_bend_error,
        "clamp_degrees": float(np.degrees(bending.clamp_angle)),
        "clamp_error_degrees": float(np.degrees(bending.clamp_angle_error)),
        "residual_mm": bending.residual,
        "change_at_ledge_mm": bending.change_at_ledge,
        "change_by_roll_mm": bending.change_by_roll,
        "trades_bend_for_weight": bending.trades_bend_for_weight,
    }
