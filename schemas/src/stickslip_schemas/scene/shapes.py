"""Bodies with an inside: how round they are, and distances of points from them at the start."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from stickslip_schemas.scene.motions import Track, rotation_matrix

Floats = npt.NDArray[np.float64]

ROUNDING = 0.005
"""Radius of the edges of a box without one of its own [m]: `ROUNDING` of the solver.

It is larger for coarse cloth (`box_rounding`).
"""

RADIUS_LEAST = 0.9
"""Least radius of what cloth touches, over the side of a cell: `radius_least` of the solver."""


def cell_side(rest: Floats, triangles: npt.NDArray[np.integer[Any]]) -> float:
    """Return the side of a cell of a sheet [m]: the square root of twice the mean triangle.

    `rest` are its flat vertices (V, 2) [m], `triangles` (T, 3).
    """
    corners = rest[triangles]
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return float(np.sqrt(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).mean()))


def box_rounding(box: Mapping[str, Any], cell: float) -> float:
    """Return the radius of the edges of a box [m] for cloth whose largest cells have a side [m]."""
    if box["rounding"] is not None:
        return float(box["rounding"])
    return float(min(max(ROUNDING, RADIUS_LEAST * cell), 0.5 * min(box["size"])))


def with_roundings(bodies: Mapping[str, Any], cell: float) -> dict[str, Any]:
    """Return bodies as JSON, with the radius of the edges of each box (see `box_rounding`)."""
    rounded: dict[str, Any] = {}
    for name, body in bodies.items():
        is_box = body["type"] == "box"
        rounded[name] = {**body, "rounding": box_rounding(body, cell)} if is_box else body
    return rounded


def start_gap(body: Mapping[str, Any], points: Floats) -> Floats:
    """Return the distances (N,) [m] of points (N, 3) from a body at 0 s; negative inside.

    The body is the JSON of a plane, sphere, cylinder, capsule, or box with its rounding.
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
