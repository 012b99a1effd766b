"""Oscillation: how much of its amplitude a swing keeps, and where a shaken floor carries cloth.

The step control of the preset chooses the steps, as in scenes.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.motion import FABRIC, MotionProtocol
from stickslip_sim_core.protocols.protocol import ClothProtocol
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.reference.oscillation import chain_period, chain_shape, shaken_block

LENGTH = 0.2  # of the strip that swings [m]
WIDTH = 0.02  # [m]
# Of the tip at the start [m]. The shape is that of small swings, so it must be small over LENGTH.
AMPLITUDE = 0.02
DURATIONS = (1.0, 2.0)  # s

# Floors that shake faster than friction can drive the cloth: by 9 and 29 g.
FREQUENCIES = (33.0, 60.0)  # 1/s
SIZE = 2e-3  # of the floor's motion [m]
MU = 1.0
REST = 0.5123  # at which the floor begins to shake, in the middle of a step [s]
SHAKEN = 0.1  # in which the way depends on friction [s]

SAMPLES = 200  # of a path in a second


@dataclass(kw_only=True, eq=False)
class Swing(ClothProtocol):
    """The amplitude that a strip keeps which swings as a chain does, against that at its start.

    Nothing but the scheme takes energy from it, so the error is the numerical damping.
    """

    name = "swing"
    x_name = "time [s]"
    y_name = "amplitude [m]"
    points = "durations"
    constants: ClassVar = {"length": LENGTH, "period": chain_period(LENGTH)}

    durations: Sequence[float] = DURATIONS
    """Times of swinging, at least a period [s]."""
    cells: int = 20
    """Number of cells along the strip."""
    tolerance: float = 5e-2

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        tip = self.path_of_tip(x)
        # The largest distance within half a period is the amplitude there.
        half = round(0.5 * chain_period(LENGTH) * SAMPLES)
        return float(np.abs(tip[-half - 1 :]).max()), AMPLITUDE

    def path_of_tip(self, until: float) -> Floats:
        """Return the mean displacement of the free end at 200 frames a second: (frames,) [m]."""
        mesh = meshes.grid(WIDTH, LENGTH, max(1, self.cells // 10), self.cells)
        below = mesh.rest[:, 1] + 0.5 * LENGTH
        top = np.flatnonzero(below > LENGTH * (1.0 - 1e-9))
        start = np.column_stack([AMPLITUDE * chain_shape(below, LENGTH), mesh.rest])
        cloth = Cloth(mesh, fabric(FABRIC), self.solver, held=top)
        cloth.set_state(start)
        gravity = cloth.gravity.copy()
        path = []
        for frame in range(round(until * SAMPLES) + 1):
            time = frame / SAMPLES
            if frame:
                cloth.advance(time, lambda _time: (gravity, start[top], ()))
            positions = cloth.positions_at(time) if frame else start
            path.append(positions[below < 1e-9 * LENGTH, 0].mean())
        self.tally.count(cloth)
        return np.array(path)

    def reported(self) -> dict[str, Setting]:
        return {**super().reported(), "cells": self.cells}


@dataclass(kw_only=True, eq=False)
class ShakenFloor(MotionProtocol):
    """The distance by which a floor carries a patch that begins to shake, against a rigid block.

    The floor shakes faster than friction can drive the patch, so the patch slips to and fro.
    """

    name = "shaken-floor"
    x_name = "frequency [1/s]"
    y_name = "distance [m]"
    points = "frequencies"
    constants: ClassVar = {"mu": MU, "size": SIZE}

    frequencies: Sequence[float] = FREQUENCIES
    """Frequencies of the floor [1/s]."""
    tolerance: float = 5e-2

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        omega = 2.0 * math.pi * x

        def floor(time: float) -> float:
            return SIZE * (1.0 - math.cos(omega * max(time - REST, 0.0)))

        along = np.array([1.0, 0.0, 0.0])
        moved = self.carried(
            REST + SHAKEN, np.zeros(3), lambda time: [plane(MU, origin=floor(time) * along)], along
        )
        return moved, shaken_block(x, SIZE, MU, SHAKEN)
