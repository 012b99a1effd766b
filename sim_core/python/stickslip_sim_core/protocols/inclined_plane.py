"""Inclined plane: the slope at which a patch of cloth begins to slide, and its creep below that slope."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.protocol import MeshedProtocol
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.protocols.strip import rectangle

FRICTION = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
SIDE = 0.1  # m
FABRIC = "gray-interlock"
DIRECTION = np.array([np.cos(0.5), np.sin(0.5)])  # down the slope, along no edge

RATE = 0.01  # 1/s: of tan(alpha) over mu
FROM, UP_TO = 0.95, 1.05  # tan(alpha) over mu
MOVED = 1e-9  # m: a patch whose vertices have all come so far slides

HOLD_SHARE = 0.9  # of the slip angle
HOLD_TIME = 10.0  # s
DRIFT_MAX = 1e-5  # m

# Of a node's weight: the force that residuals are measured in. A resting node may bear a force beyond friction by the
# preset's tolerance times this, and slides late by as much over mu.
FORCE_SHARE = 1.0


@dataclass(kw_only=True, eq=False)
class InclinedPlane(MeshedProtocol):
    """Tan(alpha) of the slope at which a patch slides, against mu.

    A patch that comes further than `DRIFT_MAX` in 10 s at 90 % of the angle atan(mu) creeps: its measurement is NaN.
    """

    name, x_name, y_name = "inclined-plane", "mu", "tan(alpha) at slip"
    points = "friction"
    grids_max = 1

    friction: Sequence[float] = FRICTION
    """Of the plane."""
    cells: int = 10
    force_share: float = FORCE_SHARE
    """Force that residuals are measured in, over a node's weight."""
    tolerance: float = 0.005

    def measure(self, mu: float, at: Mapping[str, Any]) -> tuple[float, float]:
        mesh = rectangle(SIDE, SIDE, (self.cells, self.cells), SIDE / self.cells, self.kinds[at["mesh"]], 0)
        moved = drift(mesh, mu, self.solver, force_share=self.force_share)
        self.tally.note(moved)
        slope = slip_slope(mesh, mu, self.solver, force_share=self.force_share)
        return slope if moved <= DRIFT_MAX else np.nan, mu

    def reported(self) -> dict[str, Setting]:
        return {
            **super().reported(),
            "force_scale_over_node_weight": self.force_share,
            "drift_mm": 1e3 * self.tally.largest,
            "drift_seconds": HOLD_TIME,
            "drift_share_of_slip_angle": HOLD_SHARE,
        }


def slip_slope(mesh: meshes.Mesh, mu: float, preset: SolverSettings, *, force_share: float = FORCE_SHARE) -> float:
    """Return tan(alpha) of the slope, growing by 1 % of mu a second, at which all of the patch slides, or NaN."""
    cloth, start = _laid(mesh, preset, force_share)
    floor, dt = [plane(mu)], preset.time_step
    for step in range(1, round((UP_TO - FROM) / (RATE * dt)) + 1):
        slope = mu * (FROM + RATE * step * dt)
        cloth.gravity[:] = tilted(np.arctan(slope))
        cloth.step(dt, bodies=floor)
        if np.abs(cloth.positions - start).max(axis=1).min() > MOVED:
            return float(slope)
    return np.nan


def drift(mesh: meshes.Mesh, mu: float, preset: SolverSettings, *, force_share: float = FORCE_SHARE) -> float:
    """Return the largest displacement in `HOLD_TIME` at `HOLD_SHARE` of the slip angle [m]."""
    cloth, start = _laid(mesh, preset, force_share)
    cloth.gravity[:] = tilted(HOLD_SHARE * np.arctan(mu))
    floor = [plane(mu)]
    for _ in range(round(HOLD_TIME / preset.time_step)):
        cloth.step(preset.time_step, bodies=floor)
    return float(np.abs(cloth.positions - start).max())


def tilted(angle: float) -> Floats:
    """Return gravity [m/s^2] in axes whose third is normal to a plane of this slope [rad]."""
    return GRAVITY * np.append(np.sin(angle) * DIRECTION, -np.cos(angle))


def _laid(mesh: meshes.Mesh, preset: SolverSettings, force_share: float) -> tuple[Cloth, Floats]:
    laid = fabric(FABRIC)
    weight = laid.density * mesh.spacing**2 * GRAVITY
    cloth = Cloth(mesh, laid, preset, force_scale=force_share * weight)
    start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    cloth.set_state(start)
    return cloth, start
