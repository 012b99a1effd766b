"""Stacked incline: sheets lie on each other on a slope that grows; the interface of least friction slips, alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.bodies import plane
from stickslip_sim_core.cloth.contact import SelfContact
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.inclined_plane import DRIFT_MAX, HOLD_SHARE, HOLD_TIME, tilted
from stickslip_sim_core.protocols.protocol import MeshedProtocol
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.protocols.strip import MeshKind, rectangle

FRICTION = (0.1, 0.3, 0.8, 1.5)
SHEETS = (2, 4)
TOP, WIDER = 0.1, 0.01  # m: side of the sheet on top, and by how much each one below is wider on each side
THICKNESS = 5e-4  # m
FABRIC = "gray-interlock"

ROUGHER = 1.5  # friction of all other interfaces, over the least
RATE = 0.002  # 1/s: of tan(alpha) over mu
FROM, UP_TO = 0.99, 1.01  # tan(alpha) over mu
MOVED = 1e-6  # m: sheets whose vertices have all come so far over what is below slide

# Of a node's weight: the force that residuals are measured in.
FORCE_SHARE = 0.1


@dataclass(kw_only=True, eq=False)
class StackedIncline(MeshedProtocol):
    """Tan(alpha) of the slope at which the upper sheets of a stack slide, against mu of the middle interface.

    The other interfaces are rougher than mu. A stack whose sheets come further than `DRIFT_MAX` in 10 s at 90 % of the
    angle atan(mu), or in which another interface slides, has no slip angle: its measurement is NaN.
    """

    name, x_name, y_name = "stacked-incline", "mu", "tan(alpha) at slip"
    points, parameters = "friction", {"sheets": "sheets", "mesh": "meshes"}

    friction: Sequence[float] = FRICTION
    """Of the middle interface."""
    sheets: Sequence[int] = SHEETS
    """Numbers of sheets, at least 2 each."""
    cells: int = 4
    """Of the sheet on top along a side; the others have cells of about that size."""
    tolerance: float = 0.002

    def measure(self, mu: float, at: Mapping[str, Any]) -> tuple[float, float]:
        creeping, slipping = (
            Stack(at["sheets"], mu, self.solver, self.cells, self.kinds[at["mesh"]]) for _ in range(2)
        )
        moved, slope = creeping.drift(), slipping.slip_slope()
        self.tally.note(moved)
        self.tally.count(creeping.cloth)
        self.tally.count(slipping.cloth)
        return slope if moved <= DRIFT_MAX else np.nan, mu

    def reported(self) -> dict[str, Setting]:
        return {
            **super().reported(),
            "force_scale_over_node_weight": FORCE_SHARE,
            "drift_mm": 1e3 * self.tally.largest,
            "drift_seconds": HOLD_TIME,
            "drift_share_of_slip_angle": HOLD_SHARE,
            "least_distance_over_thickness": self.tally.least_distance / THICKNESS,
            "unconverged_steps": self.tally.unconverged_steps,
        }


class Stack:
    """Sheets on each other on a slope, the widest below, with the least friction below sheet `sheets // 2`.

    Args:
        sheets: Their number.
        mu: Least friction.
        preset: Solver settings.
        cells: Of the sheet on top along a side.
        kind: Diagonals of grids, or the seed of unstructured meshes.
    """

    def __init__(
        self, sheets: int, mu: float, preset: SolverSettings, cells: int, kind: MeshKind = "alternating"
    ) -> None:
        if sheets < 2:
            raise ValueError(f"sheets: must be at least 2, got {sheets}")
        self.mu, self.loose, self.preset = mu, sheets // 2, preset
        parts = []
        for level in range(sheets):
            side = TOP + 2.0 * WIDER * (sheets - 1 - level)
            count = round(side / TOP * cells)
            parts.append(rectangle(side, side, (count, count), TOP / cells, kind, level))
        friction = np.full((sheets, sheets), ROUGHER * mu)
        friction[self.loose - 1, self.loose] = friction[self.loose, self.loose - 1] = mu
        laid = fabric(FABRIC)
        weight = laid.density * parts[-1].spacing ** 2 * GRAVITY
        mesh = meshes.together(*parts)
        self.cloth = Cloth(
            mesh,
            laid,
            preset,
            self_contact=SelfContact(friction, THICKNESS),
            force_scale=FORCE_SHARE * weight,
        )
        self.start = np.concatenate(
            [np.column_stack([p.rest, np.full(len(p.rest), level * THICKNESS)]) for level, p in enumerate(parts)]
        )
        self.level = np.repeat(np.arange(sheets), [len(p.rest) for p in parts])
        self.cloth.set_state(self.start)
        self.floor = [plane(ROUGHER * mu)]

    def moved(self) -> Floats:
        """Return the displacement of each vertex (V,) [m]."""
        return np.asarray(np.abs(self.cloth.positions - self.start).max(axis=1))

    def drift(self) -> float:
        """Return the largest displacement in `HOLD_TIME` at `HOLD_SHARE` of the slip angle [m]."""
        self.cloth.gravity[:] = tilted(HOLD_SHARE * np.arctan(self.mu))
        for _ in range(round(HOLD_TIME / self.preset.time_step)):
            self.cloth.step(self.preset.time_step, bodies=self.floor)
        return float(self.moved().max())

    def slip_slope(self) -> float:
        """Return tan(alpha) of the slope, growing by 0.2 % of mu a second, at which the upper sheets slide, or NaN.

        NaN, too, where the sheets below have moved.
        """
        dt = self.preset.time_step
        upper = self.level >= self.loose
        for step in range(1, round((UP_TO - FROM) / (RATE * dt)) + 1):
            slope = self.mu * (FROM + RATE * step * dt)
            self.cloth.gravity[:] = tilted(np.arctan(slope))
            self.cloth.step(dt, bodies=self.floor)
            moved = self.moved()
            if moved[upper].min() > MOVED:
                return float(slope) if moved[~upper].max() <= DRIFT_MAX else np.nan
        return np.nan
