"""Gripper: two jaws hold a patch of cloth by friction, and rise with it as its load grows.

Where the jaws are nearer to each other than the cloth is thick, they press on it. The load at which
the patch slips out of them gives the friction that it needed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import COMPRESSION, THICKNESS, Body, box
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.protocol import ClothProtocol
from stickslip_sim_core.protocols.result import Setting

FRICTION = (0.1, 0.3, 1.0)
FABRIC = "gray-interlock"
SIDE = 0.05  # of the patch [m]
JAW = (0.02, 0.1, 0.1)  # m: its flat face is wider than the patch
# Load over the weight of the cloth: that of gripped cloth hangs on its least part.
LOADED = 100.0
# Share of the thickness by which the jaws close.
CLOSED = 0.01
RISE = 0.1  # acceleration of the jaws [m/s^2]
# The needed friction grows from the first share of mu to the last, at this rate [1/s].
SHARES = (0.95, 1.05)
RATE = 0.05
# The patch has slipped once all of it has moved by this along the jaws [m].
SLIPPED = 1e-6


@dataclass(kw_only=True, eq=False)
class Gripper(ClothProtocol):
    """The friction that a patch needs as it slips out of two jaws, against that of the jaws.

    Jaws at a distance d press with p = COMPRESSION (1 - d/h) on each side of cloth of the thickness
    h. A load q on an area needs mu = q / (2 p).
    """

    name = "gripper"
    x_name = "mu"
    y_name = "mu needed at slip"
    points = "friction"
    thickness = THICKNESS
    constants: ClassVar = {"closed": CLOSED, "compression": COMPRESSION, "rise": RISE}

    friction: Sequence[float] = FRICTION
    """Coefficients of friction mu of both jaws."""
    cells: int = 5
    """Number of cells along a side of the patch."""
    tolerance: float = 0.01

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        grip = Grip(x, self.solver, self.cells)
        needed = grip.needed_at_slip()
        self.tally.count(grip.cloth)
        return needed, x

    def reported(self) -> dict[str, Setting]:
        return {
            "preset": self.solver.name,
            "time_step": self.solver.time_step,
            "steps": self.tally.total.steps,
            "unconverged_steps": self.tally.total.unconverged,
            "cells": self.cells,
        }


class Grip:
    """A patch between two upright jaws, that of friction `mu` with both."""

    def __init__(self, mu: float, preset: SolverSettings, cells: int) -> None:
        self.mu = mu
        self.pressure = COMPRESSION * CLOSED
        """Of each jaw on the cloth [Pa]."""
        self.middle = 0.5 * ((1.0 - CLOSED) * THICKNESS + JAW[0])
        """Distance of the jaws' middles from the plane between them [m]."""
        mesh = meshes.grid(SIDE, SIDE, cells, cells)
        cloth = fabric(FABRIC)
        self.density = cloth.density
        pull = 2.0 * self.pressure * mu * mesh.spacing**2
        self.cloth = Cloth(mesh, cloth, preset, force_scale=pull)
        # On the face of the first jaw.
        face = np.full(len(mesh.rest), 0.5 * JAW[0] - self.middle)
        self.start = np.column_stack([face, mesh.rest])
        self.cloth.set_state(self.start, bodies=self.jaws(0.0))

    def jaws(self, time: float) -> list[Body]:
        """Return both jaws at a time [s]."""
        height = 0.5 * RISE * time**2
        rounding = 0.5 * JAW[0]
        return [
            box(self.mu, JAW, rounding=rounding, origin=(side * self.middle, 0.0, height))
            for side in (-1.0, 1.0)
        ]

    def needed_at_slip(self) -> float:
        """Return the friction that the patch needs as it slips, or NaN if it does not."""
        dt = self.cloth.preset.time_step
        first, last = SHARES
        for step in range(1, round((last - first) / (RATE * dt)) + 1):
            needed = self.mu * (first + RATE * step * dt)
            # The load on the area is 2 p mu, and the acceleration of the jaws is a part of it.
            down = 2.0 * self.pressure * needed / self.density - RISE
            self.cloth.gravity[:] = (0.0, 0.0, -down)
            self.cloth.step(dt, bodies=self.jaws(step * dt))
            if self.moved(step * dt).min() > SLIPPED:
                return needed
        return np.nan

    def moved(self, time: float) -> Floats:
        """Return how far each vertex has come down along the jaws until a time [s]: (V,) [m]."""
        height = 0.5 * RISE * time**2
        moved: Floats = self.start[:, 2] + height - self.cloth.positions[:, 2]
        return moved
