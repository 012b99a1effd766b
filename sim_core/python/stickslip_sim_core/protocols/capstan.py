"""Capstan: a strip slides over a cylinder against a light pull.

Friction makes the heavy pull grow with the wrap angle.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import THICKNESS, Body, cylinder
from stickslip_sim_core.cloth.fabrics import Fabric, isotropic
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.protocol import ClothProtocol
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.reference import master_curves

FRICTION = (0.1, 0.3, 0.8, 1.5)
BENDING = (1e-4, 0.05)  # B / T1, B = D / (2 R^2)
RADIUS = 0.05  # m
WRAP = 2.0  # rad
WIDTH = 2  # cells
CELLS_PER_TURN = 72  # 5 degrees each
# Free length beyond the cylinder on each side, over its radius: many times sqrt(D/T1).
FREE = 2.0 * np.pi / 3.0
LIGHT = 2.0  # T1, N/m
DENSITY = 0.1  # kg/m^2
STRETCHING = 2e4  # N/m
SPEED = 0.01  # m/s
DAMPING = 2.0  # 1/s
# The strip first takes up the light pull without friction, for this time [s]. One that rests
# without tension cannot take up all of it in a single step with friction.
SETTLING = 0.2
# The measurement of the heavy pull begins after this time [s].
SLIDING = 1.2
# The mean covers this time [s], in which the strip slides by two cells.
MEASURED = 0.8

# Share of T1 times a cell that is the unit of residuals.
FORCE_SHARE = 0.01


@dataclass(kw_only=True, eq=False)
class Capstan(ClothProtocol):
    """Ln(T2/T1) of a strip that slides over a cylinder, with cells of 5 degrees."""

    name = "capstan"
    x_name = "mu"
    y_name = "ln(T2/T1)"
    points = "friction"
    parameters: ClassVar = {"bending": "bending"}
    constants: ClassVar = {
        "wrap": WRAP,
        "cells_per_turn": CELLS_PER_TURN,
        "speed": SPEED,
        "force_scale_over_pull_on_a_cell": FORCE_SHARE,
    }

    friction: Sequence[float] = FRICTION
    """Coefficients of friction between strip and cylinder."""
    bending: Sequence[float] = BENDING
    """Values of B / T1, each > 0."""
    tolerance: float = 0.003

    def measure(self, mu: float, at: Mapping[str, Any]) -> tuple[float, float]:
        strip = Strip(mu, at["bending"], self.solver)
        heavy, wrap = strip.draw()
        self.tally.note(float(np.ptp(heavy) / heavy.mean()))
        self.tally.count(strip.cloth)
        master = master_curves.capstan(mu, wrap, at["bending"])
        return float(np.log(heavy.mean() / LIGHT)), float(np.log(master))

    def reported(self) -> dict[str, Setting]:
        return {**super().reported(), "ripple": self.tally.largest}


class Strip:
    """A strip without weight over a cylinder along y, two cells wide.

    A pull of `light_pull` hangs on its free end.
    """

    light_pull: ClassVar[float] = LIGHT
    """Pull at the free end [N/m]."""

    apart: ClassVar[float] = 0.0
    """Distance from the cylinder at the start, in thicknesses."""

    def __init__(
        self,
        mu: float,
        bending: float,
        preset: SolverSettings,
        cells_per_turn: int = CELLS_PER_TURN,
    ) -> None:
        self.preset = preset
        self.cell = 2.0 * np.pi * RADIUS / cells_per_turn
        free = round(FREE * RADIUS / self.cell)
        cells = 2 * free + round(WRAP * RADIUS / self.cell)
        mesh = meshes.grid(cells * self.cell, WIDTH * self.cell, cells, WIDTH)
        along = mesh.rest[:, 0] - mesh.rest[:, 0].min() - free * self.cell
        self.held = np.flatnonzero(along > along.max() - 0.1 * self.cell)
        self.light = np.flatnonzero(along < along.min() + 0.1 * self.cell)
        self.bodies: list[Body] = []
        self.below = np.empty((0, 3))
        """Held vertices of other cloth, after those of the strip."""
        material = isotropic(DENSITY, STRETCHING, 2.0 * RADIUS**2 * bending * self.light_pull)
        self.breadth = WIDTH * self.cell
        # The strip starts wrapped around the cylinder, with both free ends tangential to it.
        clearance = RADIUS + self.apart * THICKNESS
        angle = np.clip(along / RADIUS, 0.0, WRAP)
        beyond = along - RADIUS * angle
        self.start = np.column_stack(
            [
                -clearance * np.cos(angle) + beyond * np.sin(angle),
                mesh.rest[:, 1],
                clearance * np.sin(angle) + beyond * np.cos(angle),
            ]
        )
        self.ahead = np.array([np.sin(WRAP), 0.0, np.cos(WRAP)])
        force_scale = FORCE_SHARE * self.light_pull * self.cell
        settled = self._settled(self._pulled(self.over(0.0, mesh, material, force_scale)))
        self.cloth = self._pulled(self.over(mu, mesh, material, force_scale))
        self.cloth.set_state(settled)
        self.iterations = 0.0
        """Mean number of Newton's iterations in a measured step."""

    def _pulled(self, cloth: Cloth) -> Cloth:
        """Let gravity on the vertices of the free end stand for the light pull."""
        cloth.gravity[:] = 0.0
        cloth.gravity[self.light, 2] = (
            -self.light_pull * self.breadth / cloth.masses[self.light].sum()
        )
        return cloth

    def _settled(self, smooth: Cloth) -> Floats:
        """Return the positions (V, 3) [m] of cloth that bears the light pull without friction."""
        smooth.set_state(np.concatenate([self.start, self.below]))
        ends = np.concatenate([self.start[self.held], self.below])
        for _ in range(round(SETTLING / self.preset.time_step)):
            smooth.step(self.preset.time_step, held=ends, bodies=self.bodies, damping=DAMPING)
        return smooth.positions

    def over(self, mu: float, mesh: meshes.Mesh, material: Fabric, force_scale: float) -> Cloth:
        """Return the cloth that slides over the cylinder. Tests let it slide over other bodies."""
        self.bodies = [cylinder(mu, RADIUS, rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]])]
        return Cloth(mesh, material, self.preset, held=self.held, force_scale=force_scale)

    def draw(self) -> tuple[Floats, float]:
        """Return the heavy pull at each measured step [N/m] and the wrap angle [rad].

        The angle is between the far directions of the strip.
        """
        dt = self.preset.time_step
        pulls = []
        first = round(SLIDING / dt)
        last = round((SLIDING + MEASURED) / dt)
        for step in range(1, last + 1):
            ends = self.start[self.held] + SPEED * step * dt * self.ahead
            before = self.cloth.total.newton
            # The held end moves on along its free part, so that the wrap angle does not change.
            self.cloth.step(
                dt, held=np.concatenate([ends, self.below]), bodies=self.bodies, damping=DAMPING
            )
            if step > first:
                self.iterations += (self.cloth.total.newton - before) / (last - first)
                pulls.append(self.cloth.reactions[self.held].sum(axis=0) / self.breadth)
        heavy = np.array(pulls)
        mean = heavy.mean(axis=0)
        # Far directions: straight down at the light end, along the pull at the held one.
        return np.linalg.norm(heavy, axis=1), float(np.arctan2(mean[0], mean[2]) % (2.0 * np.pi))
