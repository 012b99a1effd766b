"""Signed distances of points from bodies with an inside, at the start of a scene."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.motions import Track, rotation_matrix

Floats = npt.NDArray[np.float64]

ROUNDING = 0.005
"""Radius of the edges of a box without one of its own [m]: `ROUNDING` of the solver."""


def start_gap(body: Mapping[str, Any], points: Floats) -> Floats:
    """Return the distances (N,) [m] of points (N, 3) from a body at 0 s; negative inside.

    The body is the JSON of a plane, sphere, cylinder, capsule or box.
    """
    origin = np.array(body["origin"], float)
    if body["type"] == "plane":
        return np.asarray((points - origin) @ unit_normal(body))
    # In the axes of the body, whose motion may have displaced it at the start.
    turn = rotation_matrix(np.array(body["turn"], float))
    if body["motion"] is not None:
        pose = Track(body["motion"]).pose_at_start(origin)
        turn = pose[:, :3] @ turn
        origin = pose[:, :3] @ origin + pose[:, 3]
    local = (points - origin) @ turn
    match body["type"]:
        case "sphere":
            return np.asarray(np.linalg.norm(local, axis=1) - body["radius"])
        case "cylinder":
            return np.asarray(np.linalg.norm(local[:, :2], axis=1) - body["radius"])
        case "capsule":
            core = np.array([0.0, 0.0, 0.5 * body["length"]])
            return _rounded_gap(local, core, body["radius"])
        case _:
            half = 0.5 * np.array(body["size"], float)
            radius = body["rounding"]
            if radius is None:
                radius = min(ROUNDING, float(half.min()))
            return _rounded_gap(local, half - radius, radius)


def _rounded_gap(points: Floats, core: Floats, radius: float) -> Floats:
    """Return the distances (N,) [m] from a box of half sides `core` (3,) that `radius` rounds."""
    beyond = np.abs(points) - core
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    inside = np.minimum(beyond.max(axis=1), 0.0)
    return np.asarray(outside + inside - radius)


def unit_normal(plane: Mapping[str, Any]) -> Floats:
    """Return the normal of a plane, (3,), of length 1."""
    normal = np.array(plane["normal"], float)
    return np.asarray(normal / np.linalg.norm(normal))
