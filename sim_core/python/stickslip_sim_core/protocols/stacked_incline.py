"""Stacked incline: sheets lie on each other on a slope that grows; the interface of least friction slips, alone."""

from collections.abc import Sequence

import numpy as np

from stickslip_sim_core import build_info
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.meshes import Diagonals
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth, SelfContact, plane
from stickslip_sim_core.protocols.inclined_plane import (
    DRIFT_MAX,
    HOLD_SHARE,
    HOLD_TIME,
    tilted,
)
from stickslip_sim_core.protocols.result import Curve, ProtocolResult
from stickslip_sim_core.protocols.strip import DIAGONALS

FRICTION = (0.1, 0.3, 0.8, 1.5)
SHEETS = (2, 4)
TOP, WIDER = 0.1, 0.01  # m: side of the sheet on top, and by how much each one below is wider on each side
THICKNESS = 5e-4  # m
FABRIC = "gray-interlock"

ROUGHER = 1.5  # friction of all other interfaces, over the least
RATE = 0.002  # 1/s: of tan(alpha) over mu
FROM, UP_TO = 0.99, 1.01  # tan(alpha) over mu
MOVED = 1e-6  # m: sheets whose vertices have all come so far over what is below slide

# Of a node's weight: the force that residuals are measured in.
FORCE_SHARE = 0.1


def run(
    *,
    preset: str | SolverSettings = "certified",
    friction: Sequence[float] = FRICTION,
    sheets: Sequence[int] = SHEETS,
    cells: int = 4,
    structured: int = 1,
    unstructured: int = 1,
    tolerance: float = 0.002,
) -> ProtocolResult:
    """Measure tan(alpha) of the slope at which the upper sheets of a stack slide, and compare it with mu.

    Interfaces are rougher than mu but for the middle one. A stack whose sheets come further than `DRIFT_MAX` in 10 s at
    90 % of the angle atan(mu), or in which anything but the middle interface slides, has no slip angle: its measurement
    is NaN.

    Args:
        preset: Solver settings, or their name.
        friction: Of the middle interface.
        sheets: Numbers of sheets, at least 2 each.
        cells: Of the mesh of the sheet on top along a side; the others have cells of about that size.
        structured: Number of structured meshes, 0 to 4: their cells are cut along alternating, random, left or right
            diagonals.
        unstructured: Number of unstructured ones.
        tolerance: Largest |relative error| that passes.
    """
    settings = preset_named(preset)
    curves, furthest, least, unconverged = [], 0.0, np.inf, 0
    kinds: list[Diagonals | int] = [*DIAGONALS[:structured], *range(unstructured)]
    for count in sheets:
        for number, kind in enumerate(kinds):
            measured = []
            for mu in friction:
                stack = Stack(count, mu, settings, cells, kind)
                moved = stack.drift()
                furthest, unconverged = max(furthest, moved), unconverged + stack.cloth.unconverged_steps
                least = min(least, stack.cloth.least_distance)
                stack = Stack(count, mu, settings, cells, kind)
                slope = stack.slip_slope()
                unconverged += stack.cloth.unconverged_steps
                least = min(least, stack.cloth.least_distance)
                measured.append(slope if moved <= DRIFT_MAX else np.nan)
            exact = tuple(float(mu) for mu in friction)
            curves.append(Curve({"sheets": float(count), "mesh": float(number)}, exact, tuple(measured), exact))
    return ProtocolResult(
        "stacked-incline",
        "mu",
        "tan(alpha) at slip",
        tuple(curves),
        tolerance,
        {
            "preset": settings.name,
            "time_step": settings.time_step,
            "cells": cells,
            "meshes": ", ".join(
                f"{i} {'unstructured' if isinstance(kind, int) else 'grid'} {kind}" for i, kind in enumerate(kinds)
            ),
            "force_scale_over_node_weight": FORCE_SHARE,
            "drift_mm": 1e3 * furthest,
            "drift_seconds": HOLD_TIME,
            "drift_share_of_slip_angle": HOLD_SHARE,
            "least_distance_over_thickness": least / THICKNESS,
            "unconverged_steps": unconverged,
        },
        build_info().build_hash,
    )


class Stack:
    """Sheets on each other on a slope, the widest below, with the least friction below sheet `sheets // 2`.

    Args:
        sheets: Their number.
        mu: Least friction.
        preset: Solver settings.
        cells: Of the sheet on top along a side.
        kind: Diagonals of grids, or the seed of unstructured meshes.
    """

    def __init__(
        self, sheets: int, mu: float, preset: SolverSettings, cells: int, kind: Diagonals | int = "alternating"
    ) -> None:
        if sheets < 2:
            raise ValueError(f"sheets: must be at least 2, got {sheets}")
        self.mu, self.loose, self.preset = mu, sheets // 2, preset
        parts = []
        for level in range(sheets):
            side = TOP + 2.0 * WIDER * (sheets - 1 - level)
            if isinstance(kind, int):
                parts.append(meshes.unstructured(side, side, TOP / cells, kind + level))
            else:
                count = round(side / TOP * cells)
                parts.append(meshes.grid(side, side, count, count, kind, seed=level))
        friction = np.full((sheets, sheets), ROUGHER * mu)
        friction[self.loose - 1, self.loose] = friction[self.loose, self.loose - 1] = mu
        laid = fabric(FABRIC)
        weight = laid.density * parts[-1].spacing ** 2 * GRAVITY
        mesh = meshes.together(*parts)
        self.cloth = Cloth(
            mesh,
            laid,
            preset,
            self_contact=SelfContact(friction, THICKNESS),
            force_scale=FORCE_SHARE * weight,
        )
        self.start = np.concatenate(
            [np.column_stack([p.rest, np.full(len(p.rest), level * THICKNESS)]) for level, p in enumerate(parts)]
        )
        self.level = np.repeat(np.arange(sheets), [len(p.rest) for p in parts])
        self.cloth.set_state(self.start)
        self.floor = [plane(ROUGHER * mu)]

    def moved(self) -> Floats:
        """Return how far each vertex has come [m]."""
        return np.asarray(np.abs(self.cloth.positions - self.start).max(axis=1))

    def drift(self) -> float:
        """Return how far any vertex comes in `HOLD_TIME` at `HOLD_SHARE` of the slip angle [m]."""
        self.cloth.gravity[:] = tilted(HOLD_SHARE * np.arctan(self.mu))
        for _ in range(round(HOLD_TIME / self.preset.time_step)):
            self.cloth.step(self.preset.time_step, bodies=self.floor)
        return float(self.moved().max())

    def slip_slope(self) -> float:
        """Return tan(alpha) of the slope, growing by 0.2 % of mu a second, at which the upper sheets slide, or NaN.

        NaN, too, where the sheets below have moved.
        """
        dt = self.preset.time_step
        upper = self.level >= self.loose
        for step in range(1, round((UP_TO - FROM) / (RATE * dt)) + 1):
            slope = self.mu * (FROM + RATE * step * dt)
            self.cloth.gravity[:] = tilted(np.arctan(slope))
            self.cloth.step(dt, bodies=self.floor)
            moved = self.moved()
            if moved[upper].min() > MOVED:
                return float(slope) if moved[~upper].max() <= DRIFT_MAX else np.nan
        return np.nan
