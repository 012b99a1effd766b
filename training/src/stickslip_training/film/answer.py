"""The answer to a film: as JSON, and in words."""

import math
from typing import Any

import numpy as np

from stickslip_training.film.drag import Drag
from stickslip_training.film.measuring import Film, Slip


def answer_of(film: Film, drag: Drag) -> dict[str, Any]:
    """Return the answer as JSON; angles are in degrees, times in seconds."""
    slip = film.slip
    return {
        "film": str(film.path),
        "frames": film.sightings.frames,
        "frames_with_both_boards": len(film.sightings.times),
        "camera": {
            "focal_px": round(film.lens.focal, 1),
            "focal_sd_px": round(film.lens.focal_sd, 1),
            "k1": round(film.lens.k1, 4),
        },
        "tilt": {
            "at_start_degrees": _degrees(film.tilt_at_start),
            "steepest_degrees": _degrees(film.steepest),
        },
        "slip": None if slip is None else _slip(slip),
        "mu": _mu(film),
        "no_answer": None if slip is not None else nothing_slides(film),
        "drag": {"begins": drag.begins, "mu": drag.mu, "no_answer": drag.no_answer},
    }


def nothing_slides(film: Film) -> str:
    """Return what a film says in which no slide was seen: the cloth stayed, or was not followed."""
    steepest = f"{np.degrees(film.steepest):.1f} degrees"
    motion = film.motion
    if motion.stayed:
        return (
            f"the cloth must slide, and stays up to a tilt of {steepest}, so mu is above "
            f"{math.tan(film.steepest):.2f}; tilt the tray further"
        )
    return (
        f"the cloth must be seen to slide or to stay. Up to a tilt of {steepest} no slide was seen "
        f"and {motion.left} of {motion.patches} patches of the tray have left their place; film "
        "it nearer and brighter, between the board and the lower edge of the tray, and keep hands "
        "off the tray"
    )


def lines_of(film: Film, drag: Drag) -> list[str]:
    """Return the answer in words, both numbers side by side."""
    slip = film.slip
    at_start = np.degrees(film.tilt_at_start)
    lines = [
        f"boards: in {len(film.sightings.times)} of {film.sightings.frames} frames; the tray lies "
        f"at {at_start:.1f} degrees at the start"
    ]
    if slip is None:
        lines.append(f"tilt: {nothing_slides(film)}")
    else:
        low, high = slip.interval
        lines.append(
            f"tilt: the cloth slides at {slip.onset.time:.2f} s and "
            f"{np.degrees(slip.tilt.angle):.2f} +- {np.degrees(slip.sd):.2f} degrees: static mu "
            f"{slip.mu:.3f}, 80 % interval {low:.3f} to {high:.3f}"
        )
    lines.append(f"drag: {_drag_line(drag)}")
    return lines


def _drag_line(drag: Drag) -> str:
    if drag.mu is None:
        return f"no answer: {drag.no_answer}"
    high = f"above {drag.mu['above']:g}" if drag.mu["above"] else f"{drag.mu['high']:.2f}"
    return (
        f"mu {drag.mu['median']:.2f} of the network, 80 % interval {drag.mu['low']:.2f} to {high}"
    )


def _degrees(angle: float) -> float:
    return round(float(np.degrees(angle)), 3)


def _slip(slip: Slip) -> dict[str, Any]:
    return {
        "time": round(slip.onset.time, 4),
        "time_sd": round(slip.onset.sd, 4),
        "tilt_degrees": _degrees(slip.tilt.angle),
        "tilt_sd_degrees": _degrees(slip.sd),
        "tilt_rate_degrees_per_second": _degrees(slip.tilt.rate),
        "errors_degrees": {name: _degrees(sd) for name, sd in slip.errors.items()},
        "patches": slip.slide.patches,
    }


def _mu(film: Film) -> dict[str, float | None] | None:
    if film.slip is None and not film.motion.stayed:
        return None
    if film.slip is None:
        return {"median": None, "low": None, "high": None, "above": math.tan(film.steepest)}
    low, high = film.slip.interval
    return {
        "median": round(film.slip.mu, 4),
        "low": round(low, 4),
        "high": round(high, 4),
        "above": None,
    }
