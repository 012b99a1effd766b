"""Tilting table: the angle at which a sheet begins to slide, tan(alpha) = mu."""

from dataclasses import dataclass

import numpy as np

from stickslip_sim_core.arrays import check_range
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.inclined_plane import SIDE, tilted

RATE = np.radians(1.0)
"""Tilt of the table in a second [rad/s]."""
CELLS = 10
"""Cells along a side of the sheet."""
SLID = 1e-4
"""The sheet slides when all of its vertices have moved this far [m], as an eye would see it."""
STEEPEST = np.radians(85.0)
"""Largest tilt of the table [rad]."""


@dataclass(frozen=True)
class SlipAngle:
    """The result of a tilting table."""

    fabric: str
    mu: float
    """Coefficient of friction that the sheet was simulated with."""

    angle: float
    """Tilt at which the sheet has slid by 0.1 mm [rad]; NaN: it does not slide up to 85 degrees."""

    @property
    def read_mu(self) -> float:
        """Coefficient of friction that the table reads."""
        return float(np.tan(self.angle))


def tilt(fabric: Fabric, mu: float) -> SlipAngle:
    """Tilt a table by one degree in a second until a sheet on it slides.

    Raises:
        ValueError: mu is not from 0.01 to 10.
    """
    check_range("mu", mu, 0.01, 10.0)
    mesh = meshes.grid(SIDE, SIDE, CELLS, CELLS)
    preset = preset_named("certified")
    cloth = Cloth(mesh, fabric, preset)
    start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    cloth.set_state(start)
    table = [plane(mu)]
    angle = 0.0
    while angle < STEEPEST:
        angle += RATE * preset.time_step
        cloth.gravity[:] = tilted(angle)
        cloth.step(preset.time_step, bodies=table)
        # The sheet slides as a whole only when its last vertex does.
        if np.abs(cloth.positions - start).max(axis=1).min() > SLID:
            return SlipAngle(fabric.name, mu, angle)
    return SlipAngle(fabric.name, mu, np.nan)
