"""Cantilever test: the bending length of a strip that bends under its own weight [ASTM D1388].

A strip is pushed over the edge of a platform until its end touches a plane that falls by 41.5
degrees from the edge. Half of this overhang is the bending length c, and the flexural rigidity is

    D = rho_A g c^3
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import Fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.lab.settling import settle

Direction = Literal["warp", "weft"]

ANGLE = np.radians(41.5)
"""Slope of the plane [rad]."""
WIDTH = 0.025
"""Width of the strip [m]."""
CELLS = 32
"""Cells along the overhang."""
REST_SHARE = 2e-5
"""Largest motion in a long step of a strip at rest, over its length."""
FORCE_SHARE = 0.1
"""Share of the weight of a node that is the unit of residuals, as in the protocol."""
TOLERANCE = 1e-3
"""Relative error of the overhang at which the search ends."""
TRIES_MAX = 12
"""Most overhangs that are tried."""


@dataclass(frozen=True)
class BendingLength:
    """The result of a cantilever test."""

    fabric: str
    direction: Direction
    overhang: float
    """Overhang at 41.5 degrees [m]."""

    stated_rigidity: float
    """Rigidity of the card along this direction [N m]."""

    density: float
    """Mass per area [kg/m^2]."""

    @property
    def bending_length(self) -> float:
        """Half of the overhang [m]."""
        return 0.5 * self.overhang

    @property
    def rigidity(self) -> float:
        """Rigidity that the test reads [N m]."""
        return self.density * GRAVITY * self.bending_length**3


def cantilever(fabric: Fabric, direction: Direction) -> BendingLength:
    """Find the overhang at which the end of a strip touches the plane.

    Raises:
        ValueError: No overhang was found: the strip did not come to rest, or it is too heavy.
    """
    number = ("warp", "weft").index(direction)
    stated = float(fabric.rigidity[number, number])
    overhang = 2.0 * float(np.cbrt(stated / (fabric.density * GRAVITY)))
    # The slope of the end grows about as the cube of the overhang: tan(slope) = k O^3 near it.
    for _ in range(TRIES_MAX):
        slope = _slope_of_end(fabric, direction, overhang)
        change = float(np.cbrt(np.tan(ANGLE) / slope))
        if not np.isfinite(change):
            raise ValueError(
                f"cantilever: a strip of {1e3 * overhang:.1f} mm along the {direction} of "
                f"{fabric.name} must come to rest, and it does not"
            )
        overhang *= change
        if abs(change - 1.0) < TOLERANCE:
            return BendingLength(fabric.name, direction, overhang, stated, fabric.density)
    raise ValueError(
        f"cantilever: an overhang along the {direction} of {fabric.name} must be found in "
        f"{TRIES_MAX} tries, and it is not"
    )


def _slope_of_end(fabric: Fabric, direction: Direction, overhang: float) -> float:
    """Return drop over reach of the end of a strip, or NaN if it does not come to rest."""
    # Two rows of vertices are clamped, half a cell on each side of the edge.
    cell = overhang / (CELLS - 0.5)
    across = max(2, round(WIDTH / cell))
    sides = (CELLS * cell, across * cell)
    cells = (CELLS, across)
    if direction == "weft":
        sides = sides[::-1]
        cells = cells[::-1]
    mesh = meshes.grid(*sides, *cells)
    axis = ("warp", "weft").index(direction)
    along = mesh.rest[:, axis] - mesh.rest[:, axis].min() - 0.5 * cell
    held = np.flatnonzero(along < 0.75 * cell)

    weight = fabric.density * GRAVITY * mesh.spacing**2
    cloth = Cloth(
        mesh, fabric, preset_named("certified"), held=held, force_scale=FORCE_SHARE * weight
    )
    start = np.column_stack([mesh.rest, np.zeros(len(along))])
    cloth.set_state(start)
    if not settle(cloth, start[held], rest=REST_SHARE * overhang):
        return np.nan
    end = np.flatnonzero(along > overhang - 0.25 * cell)
    drop = -float(cloth.positions[end, 2].mean())
    edge = start[np.argmin(along), axis] + 0.5 * cell
    return drop / float(cloth.positions[end, axis].mean() - edge)
