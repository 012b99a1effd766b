"""Motion: how far cloth falls, how far it slides until it rests, and the impulse of its impact.

All have closed forms. The step control of the preset chooses the steps, as in scenes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body, plane, sphere
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.inclined_plane import DIRECTION
from stickslip_sim_core.protocols.protocol import ClothProtocol
from stickslip_sim_core.protocols.result import Setting

SIDE = 0.1  # m
FABRIC = "gray-interlock"
DURATIONS = (0.1, 0.3, 0.5)  # s
FRICTION = (0.1, 0.3, 1.0)
SPEED = 0.6  # at the start of a slide [m/s]
DOWN = (0.0, 0.0, -GRAVITY)
"""Gravity [m/s^2]."""
HEIGHTS = (0.005, 0.05)
BALL = 0.03  # radius [m]
# Of the cloth with the ball and the floor.
IMPACT_FRICTION = 0.5
IMPACT_TIME = 1.0  # s: cloth rests by then
# A slide is over by then, with a margin for one that is too long.
LONGER = 1.2


@dataclass(kw_only=True, eq=False)
class MotionProtocol(ClothProtocol):
    """A patch of cloth that moves without deforming, under the step control of the preset."""

    cells: int = 5
    """Number of cells along a side of the patch."""

    def moved(
        self,
        until: float,
        velocity: Floats,
        bodies: Sequence[Body],
        along: Floats,
        gravity: ArrayLike = DOWN,
    ) -> float:
        """Return how far a flat patch moves along a direction until a time [s]: mean, in m."""
        return self.carried(until, velocity, lambda _time: bodies, along, gravity)

    def carried(
        self,
        until: float,
        velocity: Floats,
        bodies: Callable[[float], Sequence[Body]],
        along: Floats,
        gravity: ArrayLike = DOWN,
    ) -> float:
        """Return the same for bodies that move: a function of the time [s]."""
        mesh = meshes.grid(SIDE, SIDE, self.cells, self.cells)
        cloth = Cloth(mesh, fabric(FABRIC), self.solver)
        start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
        cloth.set_state(start, np.tile(velocity, (len(start), 1)), bodies(0.0))
        at_vertices = np.tile(np.asarray(gravity, float), (len(start), 1))
        nothing_held = np.empty((0, 3))
        cloth.advance(until, lambda time: (at_vertices, nothing_held, bodies(time)))
        self.tally.count(cloth)
        return float((cloth.positions_at(until) - start).mean(axis=0) @ along)

    def reported(self) -> dict[str, Setting]:
        return {**super().reported(), "cells": self.cells}


@dataclass(kw_only=True, eq=False)
class Fall(MotionProtocol):
    """The distance that a patch has fallen after a time, against g t^2/2."""

    name = "fall"
    x_name = "time [s]"
    y_name = "distance [m]"
    points = "durations"

    durations: Sequence[float] = DURATIONS
    """Times of falling [s]."""
    tolerance: float = 1e-4

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        down = np.array([0.0, 0.0, -1.0])
        return self.moved(x, np.zeros(3), (), down), 0.5 * GRAVITY * x * x


@dataclass(kw_only=True, eq=False)
class SlideToRest(MotionProtocol):
    """The distance that a patch slides on a level plane until it rests, against v^2/(2 mu g)."""

    name = "slide-to-rest"
    x_name = "mu"
    y_name = "distance [m]"
    points = "friction"
    constants: ClassVar = {"speed": SPEED}

    friction: Sequence[float] = FRICTION
    """Coefficients of friction mu."""
    tolerance: float = 3e-3

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        # Along no edge of the mesh.
        along = np.append(DIRECTION, 0.0)
        until = LONGER * SPEED / (x * GRAVITY)
        return self.moved(until, SPEED * along, [plane(x)], along), SPEED**2 / (2.0 * x * GRAVITY)


@dataclass(kw_only=True, eq=False)
class Impact(ClothProtocol):
    """The impulse of contact on a patch that falls on a ball until it rests, over its weight.

    The patch begins and ends at rest, so contact bears the weight in the mean, whatever the impact
    is like. The forces are those of the ball and the floor on the vertices, in each step.
    """

    name = "impact"
    x_name = "height [m]"
    y_name = "impulse over weight times duration"
    points = "heights"
    constants: ClassVar = {"ball": BALL, "mu": IMPACT_FRICTION, "duration": IMPACT_TIME}

    heights: Sequence[float] = HEIGHTS
    """Heights of the patch over the ball at the start [m]."""
    cells: int = 10
    """Number of cells along a side of the patch."""
    tolerance: float = 0.01

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        mesh = meshes.grid(SIDE, SIDE, self.cells, self.cells)
        cloth = Cloth(mesh, fabric(FABRIC), self.solver)
        bodies = [
            plane(IMPACT_FRICTION),
            sphere(IMPACT_FRICTION, BALL, origin=(0.0, 0.0, BALL)),
        ]
        cloth.set_state(
            np.column_stack([mesh.rest, np.full(len(mesh.rest), 2.0 * BALL + x)]), bodies=bodies
        )
        gravity = cloth.gravity.copy()
        nothing_held = np.empty((0, 3))
        impulse = 0.0

        def add_step() -> bool:
            nonlocal impulse
            touching = cloth.contacts >= 0
            force = float(cloth.reactions[touching, 2].sum())
            impulse += force * (cloth.time - cloth.last_begin)
            return False

        cloth.advance(IMPACT_TIME, lambda _time: (gravity, nothing_held, bodies), is_over=add_step)
        self.tally.count(cloth)
        mass = cloth.masses
        left = float(mass @ cloth.velocities[:, 2])
        return impulse / (mass.sum() * GRAVITY * cloth.time), 1.0 + left / (
            mass.sum() * GRAVITY * cloth.time
        )

    def reported(self) -> dict[str, Setting]:
        return {**super().reported(), "cells": self.cells}
