"""Static and kinetic friction: the slope at which cloth begins to slide, and how it slides then."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.cloth.contact import Body, plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.inclined_plane import (
    DIRECTION,
    FABRIC,
    SIDE,
    OnSlope,
    SlopeProtocol,
    tilted,
)
from stickslip_sim_core.protocols.motion import MotionProtocol
from stickslip_sim_core.protocols.protocol import rectangle

STATIC_FRICTION = (0.2, 0.5, 1.0)
KINETIC_SHARE = 0.7
"""Kinetic over static coefficient of friction."""

SLOPE = 1.02
"""Tan(alpha) over the static coefficient, on which cloth slides from rest."""

SLIDE_TIME = 0.5
"""Time of a slide from rest [s]."""


def rough_plane(mu_static: float) -> Body:
    """Return a plane of this static friction, and less kinetic friction."""
    return replace(plane(KINETIC_SHARE * mu_static), mu_static=mu_static)


@dataclass(kw_only=True, eq=False)
class StaticOnset(SlopeProtocol):
    """The slope at which a patch at rest begins to slide, tan(alpha) = mu_s."""

    name = "static-onset"
    x_name = "static mu"
    grids_max = 1
    # A node may bear more than friction by the preset's tolerance times this.
    force_share = 0.1
    constants: ClassVar = {**SlopeProtocol.constants, "kinetic_over_static": KINETIC_SHARE}

    friction: Sequence[float] = STATIC_FRICTION
    cells: int = 6
    tolerance: float = 2e-3

    def lay(self, mu: float, at: Mapping[str, Any]) -> OnSlope:
        mesh = rectangle(
            SIDE, SIDE, (self.cells, self.cells), SIDE / self.cells, self.kinds[at["mesh"]], 0
        )
        laid = fabric(FABRIC)
        weight = laid.density * mesh.spacing**2 * GRAVITY
        cloth = Cloth(mesh, laid, self.solver, force_scale=self.force_share * weight)
        start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
        return OnSlope(cloth, start, mu, rough_plane(mu), np.ones(len(start), dtype=bool))


@dataclass(kw_only=True, eq=False)
class KineticSlide(MotionProtocol):
    """The distance that a patch at rest slides in `SLIDE_TIME` on a slope above atan(mu_s).

    The master is g (sin(alpha) - mu_k cos(alpha)) t^2/2.
    """

    name = "kinetic-slide"
    x_name = "kinetic mu"
    y_name = "distance [m]"
    points = "friction"
    constants: ClassVar = {
        "kinetic_over_static": KINETIC_SHARE,
        "slope_over_static": SLOPE,
        "duration": SLIDE_TIME,
    }

    friction: Sequence[float] = tuple(KINETIC_SHARE * mu for mu in STATIC_FRICTION)
    """Kinetic coefficients of friction."""
    tolerance: float = 2e-3

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        mu_static = x / KINETIC_SHARE
        alpha = float(np.arctan(SLOPE * mu_static))
        # Along no edge of the mesh.
        along = np.append(DIRECTION, 0.0)
        still = np.zeros(3)
        gravity = tilted(alpha)
        distance = self.moved(SLIDE_TIME, still, [rough_plane(mu_static)], along, gravity)
        acceleration = GRAVITY * (np.sin(alpha) - x * np.cos(alpha))
        return distance, 0.5 * acceleration * SLIDE_TIME**2
