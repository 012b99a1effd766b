"""The core with a fault, which the variable FAULT names: an adapter for test_faults.py."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from stickslip_measure.adapters.stickslip import Simulator as Core

FAULT = os.environ["FAULT"]


def slippery(scene: Any) -> Any:
    """Return the scene with nine tenths of its friction."""
    bodies = tuple(replace(body, friction=0.9 * body.friction) for body in scene.bodies)
    between = None if scene.friction is None else 0.9 * scene.friction
    return replace(scene, bodies=bodies, friction=between)


def stiff(scene: Any) -> Any:
    """Return the scene with 1.2 times its bending stiffness."""
    return replace(scene, bending=1.2 * scene.bending)


def displaced(scene: Any) -> Any:
    """Return the scene with its held rows half a cell behind their place."""
    # A hook is no clamp.
    if len(scene.held) < 2:
        return scene
    start = scene.start.copy()
    rest = scene.rest.copy()
    start[scene.held, 0] += 0.5 * scene.cell
    rest[scene.held, 0] += 0.5 * scene.cell
    return replace(scene, start=start, rest=rest)


CHANGES: dict[str, Callable[[Any], Any]] = {
    "friction": slippery,
    "bending": stiff,
    "clamp": displaced,
}


class Simulator:
    name = "faulty"
    version = "0"
    capabilities = Core.capabilities
    settings = Core.settings

    def __init__(self, scene: Any, setting: str) -> None:
        self.scene = scene
        change = CHANGES.get(FAULT, lambda scene: scene)
        self.core = Core(change(scene), setting)
        self.frame = self.core.frame
        self.quiet = 0
        self.set_gravity(scene.gravity)

    def step(self) -> None:
        # The solver falls asleep after 20 quiet steps, and never wakes up.
        if FAULT == "sleep" and self.quiet >= 20:
            return
        before = self.core.positions()
        self.core.step()
        speed = np.abs(self.core.positions() - before).max() / self.frame
        self.quiet = self.quiet + 1 if speed < 0.01 else 0

    def positions(self) -> Any:
        x = self.core.positions().copy()
        if FAULT == "clamp":
            x[self.scene.held] = self.scene.start[self.scene.held]
        return 1e3 * x if FAULT == "millimetres" else x

    def set_gravity(self, gravity: Any) -> None:
        pull = np.tile(gravity, (len(self.scene.start), 1))
        # A hung sheet rests as if all of its vertices had the same mass.
        if FAULT == "masses" and len(self.scene.held):
            masses = self.core.cloth.masses
            pull *= (masses.mean() / masses)[:, None]
        self.core.set_gravity(pull)

    def damp(self, rate: float) -> None:
        self.core.damp(rate)
