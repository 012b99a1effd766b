"""Inclined plane: the slope at which a patch of cloth begins to slide, and how far it creeps below."""

from collections.abc import Iterator, Sequence

import numpy as np

from stickslip_sim_core import build_info
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth, plane
from stickslip_sim_core.protocols.result import Curve, ProtocolResult

FRICTION = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
SIDE = 0.1  # m
FABRIC = "gray-interlock"
DIRECTION = np.array([np.cos(0.5), np.sin(0.5)])  # down the slope, along no edge

RATE = 0.01  # 1/s: of tan(alpha) over mu
FROM, UP_TO = 0.95, 1.05  # tan(alpha) over mu
MOVED = 1e-9  # m: a patch whose vertices have all come so far slides

HOLD_SHARE = 0.9  # of the slip angle
HOLD_TIME = 10.0  # s
DRIFT_MAX = 1e-5  # m

# Of a node's weight: the force that residuals are measured in. A resting node may bear a force beyond friction by the
# preset's tolerance times this, and slides late by as much over mu.
FORCE_SHARE = 1.0


def run(
    *,
    preset: str | SolverSettings = "certified",
    friction: Sequence[float] = FRICTION,
    cells: int = 10,
    structured: int = 1,
    unstructured: int = 1,
    force_share: float = FORCE_SHARE,
    tolerance: float = 0.005,
) -> ProtocolResult:
    """Measure tan(alpha) of the slope at which a patch slides, and compare it with mu.

    A patch that comes further than `DRIFT_MAX` in 10 s at 90 % of the angle atan(mu) has no slip angle: it creeps, and
    its measurement is NaN.

    Args:
        preset: Solver settings, or their name.
        friction: Of the plane.
        cells: Of a mesh along a side.
        structured: Number of structured meshes, 0 or 1.
        unstructured: Number of unstructured ones.
        force_share: Force that residuals are measured in, over a node's weight.
        tolerance: Largest |relative error| that passes.
    """
    settings = preset_named(preset)
    curves, names, furthest = [], [], 0.0
    for number, (name, mesh) in enumerate(_patches(cells, structured, unstructured)):
        measured = []
        for mu in friction:
            moved = drift(mesh, mu, settings, force_share=force_share)
            furthest = max(furthest, moved)
            slope = slip_slope(mesh, mu, settings, force_share=force_share)
            measured.append(slope if moved <= DRIFT_MAX else np.nan)
        exact = tuple(float(mu) for mu in friction)
        curves.append(Curve({"mesh": float(number)}, exact, tuple(measured), exact))
        names.append(f"{number} {name}")
    return ProtocolResult(
        "inclined-plane",
        "mu",
        "tan(alpha) at slip",
        tuple(curves),
        tolerance,
        {
            "preset": settings.name,
            "time_step": settings.time_step,
            "cells": cells,
            "meshes": ", ".join(names),
            "force_scale_over_node_weight": force_share,
            "drift_mm": 1e3 * furthest,
            "drift_seconds": HOLD_TIME,
            "drift_share_of_slip_angle": HOLD_SHARE,
        },
        build_info().build_hash,
    )


def slip_slope(mesh: meshes.Mesh, mu: float, preset: SolverSettings, *, force_share: float = FORCE_SHARE) -> float:
    """Return tan(alpha) of the slope, growing by 1 % of mu a second, at which all of the patch slides, or NaN."""
    cloth, start = _laid(mesh, preset, force_share)
    floor, dt = [plane(mu)], preset.time_step
    for step in range(1, round((UP_TO - FROM) / (RATE * dt)) + 1):
        slope = mu * (FROM + RATE * step * dt)
        cloth.gravity[:] = tilted(np.arctan(slope))
        cloth.step(dt, bodies=floor)
        if np.abs(cloth.positions - start).max(axis=1).min() > MOVED:
            return float(slope)
    return np.nan


def drift(mesh: meshes.Mesh, mu: float, preset: SolverSettings, *, force_share: float = FORCE_SHARE) -> float:
    """Return how far any vertex comes in `HOLD_TIME` at `HOLD_SHARE` of the slip angle [m]."""
    cloth, start = _laid(mesh, preset, force_share)
    cloth.gravity[:] = tilted(HOLD_SHARE * np.arctan(mu))
    floor = [plane(mu)]
    for _ in range(round(HOLD_TIME / preset.time_step)):
        cloth.step(preset.time_step, bodies=floor)
    return float(np.abs(cloth.positions - start).max())


def tilted(angle: float) -> Floats:
    """Return gravity [m/s^2] in axes whose third is normal to a plane of this slope [rad]."""
    return GRAVITY * np.append(np.sin(angle) * DIRECTION, -np.cos(angle))


def _laid(mesh: meshes.Mesh, preset: SolverSettings, force_share: float) -> tuple[Cloth, Floats]:
    laid = fabric(FABRIC)
    weight = laid.density * mesh.spacing**2 * GRAVITY
    cloth = Cloth(mesh, laid, preset, force_scale=force_share * weight)
    start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    cloth.set_state(start)
    return cloth, start


def _patches(cells: int, structured: int, unstructured: int) -> Iterator[tuple[str, meshes.Mesh]]:
    if structured:
        yield "grid alternating", meshes.grid(SIDE, SIDE, cells, cells)
    for seed in range(unstructured):
        yield f"unstructured {seed}", meshes.unstructured(SIDE, SIDE, SIDE / cells, seed)
