"""Capstan: a strip is drawn over a cylinder against a light pull; friction makes the heavy pull grow with the wrap."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import Body, cylinder
from stickslip_sim_core.cloth.contact import THICKNESS, SelfContact, Surface
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.protocol import ClothProtocol
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.reference import master_curves

FRICTION = (0.1, 0.3, 0.8, 1.5)
BENDING = (1e-4, 0.05)  # B / T1, B = D / (2 R^2)
RADIUS, WRAP = 0.05, 2.0  # m, rad
CELLS_PER_TURN = 72  # 5 degrees each
FREE = 2.0 * np.pi / 3.0  # beyond the cylinder, on each side, over its radius: many times sqrt(D/T1)
LIGHT = 2.0  # T1, N/m
DENSITY, STRETCHING = 0.1, 2e4  # kg/m^2, N/m
SPEED, DAMPING = 0.01, 2.0  # m/s, 1/s
SLIDING = 1.2  # s: after which the heavy pull is measured
MEASURED = 0.8  # s: over which its mean is taken, two cells of way

# Of T1 times a cell: the force that residuals are measured in.
FORCE_SHARE = 0.01


@dataclass(kw_only=True, eq=False)
class Capstan(ClothProtocol):
    """Ln(T2/T1) of a strip that slides over a cylinder, with cells of 5 degrees."""

    name, x_name, y_name = "capstan", "mu", "ln(T2/T1)"
    points, parameters = "friction", {"bending": "bending"}

    friction: Sequence[float] = FRICTION
    """Of strip and cylinder."""
    bending: Sequence[float] = BENDING
    """B / T1, each > 0."""
    tolerance: float = 0.003

    def measure(self, mu: float, at: Mapping[str, Any]) -> tuple[float, float]:
        strip = Strip(mu, at["bending"], self.solver)
        heavy, wrap = strip.draw()
        self.tally.note(float(np.ptp(heavy) / heavy.mean()))
        self.tally.count(strip.cloth)
        master = master_curves.capstan(mu, wrap, at["bending"])
        return float(np.log(heavy.mean() / LIGHT)), float(np.log(master))

    def reported(self) -> dict[str, Setting]:
        return {
            **super().reported(),
            "wrap": WRAP,
            "cells_per_turn": CELLS_PER_TURN,
            "speed": SPEED,
            "ripple": self.tally.largest,
            "force_scale_over_pull_on_a_cell": FORCE_SHARE,
            **self.counted(),
        }


class Strip:
    """A strip without weight over a cylinder along y, two cells wide. A pull of `LIGHT` hangs on its free end.

    Args:
        mu: Friction.
        bending: B / T1.
        preset: Solver settings.
        facets: Of a cylinder of triangles, all around; None: the cylinder is round.
        of_cloth: These triangles are another cloth, all of whose vertices are held.
        width: In cells.
        cells_per_turn: How fine the strip is.

    Raises:
        ValueError: The cylinder is of cloth, and `facets` is None.
    """

    def __init__(
        self,
        mu: float,
        bending: float,
        preset: SolverSettings,
        facets: int | None = None,
        *,
        of_cloth: bool = False,
        width: int = 2,
        cells_per_turn: int = CELLS_PER_TURN,
    ) -> None:
        self.preset = preset
        cell = 2.0 * np.pi * RADIUS / cells_per_turn
        free = round(FREE * RADIUS / cell)
        cells = 2 * free + round(WRAP * RADIUS / cell)
        mesh = meshes.grid(cells * cell, width * cell, cells, width)
        along = mesh.rest[:, 0] - mesh.rest[:, 0].min() - free * cell
        self.held = np.flatnonzero(along > along.max() - 0.1 * cell)
        light = np.flatnonzero(along < along.min() + 0.1 * cell)
        parts, self.below = [mesh], np.empty((0, 3))
        surfaces: list[Surface] = []
        self.bodies: list[Body] = []
        if of_cloth:
            if facets is None:
                raise ValueError("facets: must be a number where the cylinder is of cloth, got None")
            sheet, self.below = cover(facets, (width + 2) * cell)
            parts.append(sheet)
            apart = 0.1
        elif facets is None:
            self.bodies.append(cylinder(mu, RADIUS, rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
            apart = 0.0
        else:
            surfaces.append(tube(facets, width * cell, mu))
            apart = 0.01
        self.cloth = Cloth(
            meshes.together(*parts),
            isotropic(DENSITY, STRETCHING, 2.0 * RADIUS**2 * bending * LIGHT),
            preset,
            held=np.append(self.held, len(mesh.rest) + np.arange(len(self.below))),
            self_contact=SelfContact(mu, bearing="vertices") if of_cloth else None,
            surfaces=surfaces,
            force_scale=FORCE_SHARE * LIGHT * cell,
        )
        self.breadth = width * cell
        self.cloth.gravity[:] = 0.0
        self.cloth.gravity[light, 2] = -LIGHT * self.breadth / self.cloth.masses[light].sum()
        clearance = RADIUS + apart * THICKNESS
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
        self.cloth.set_state(np.concatenate([self.start, self.below]))
        self.iterations = 0.0
        """Of Newton's method in a measured step, in the mean."""

    def draw(self) -> tuple[Floats, float]:
        """Return the heavy pull at each measured step [N/m], and the angle between the far directions [rad]."""
        dt, pulls = self.preset.time_step, []
        first, last = round(SLIDING / dt), round((SLIDING + MEASURED) / dt)
        for step in range(1, last + 1):
            ends = self.start[self.held] + SPEED * step * dt * self.ahead
            before = self.cloth.newton
            self.cloth.step(dt, held=np.concatenate([ends, self.below]), bodies=self.bodies, damping=DAMPING)
            if step > first:
                self.iterations += (self.cloth.newton - before) / (last - first)
                pulls.append(self.cloth.reactions[self.held].sum(axis=0) / self.breadth)
        heavy = np.array(pulls)
        mean = heavy.mean(axis=0)
        # Far directions: straight down at the light end, along the pull at the held one.
        return np.linalg.norm(heavy, axis=1), float(np.arctan2(mean[0], mean[2]) % (2.0 * np.pi))


def tube(facets: int, breadth: float, mu: float) -> Surface:
    """Return a cylinder of triangles along y, wider than such a strip, the middle of which touches at the radius."""
    angle = 2.0 * np.pi * np.arange(facets) / facets
    ring = (RADIUS - THICKNESS) * np.column_stack([np.cos(angle), 0.0 * angle, np.sin(angle)])
    i = np.arange(facets)
    j = (i + 1) % facets
    triangles = np.concatenate([np.column_stack([i, j, facets + i]), np.column_stack([j, facets + j, facets + i])])
    return Surface(triangles, np.concatenate([ring + np.array([0.0, s * breadth, 0.0]) for s in (-1.0, 1.0)]), mu)


def cover(facets: int, breadth: float) -> tuple[meshes.Mesh, Floats]:
    """Return a sheet around the arc that the strip lies on and 30 degrees more, and its vertices (V, 3) [m]."""
    angle = 2.0 * np.pi / facets
    cells = int(np.ceil((WRAP + np.pi / 6.0) / angle))
    radius = RADIUS - THICKNESS
    mesh = meshes.grid(cells * angle * radius, breadth, cells, max(2, round(breadth / (angle * radius))))
    at = 0.5 * WRAP + mesh.rest[:, 0] / radius
    return mesh, np.column_stack([-radius * np.cos(at), mesh.rest[:, 1], radius * np.sin(at)])
