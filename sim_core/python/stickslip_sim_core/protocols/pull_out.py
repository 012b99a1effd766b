"""Pull-out: a sheet is drawn out from between two loaded sheets.

Both sides of the drawn sheet rub.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import SelfContact, plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.protocol import MeshedProtocol, MeshKind, rectangle

FRICTION = (0.1, 0.3, 0.8, 1.5)
LOADS = (1.0, 4.0)  # weight of the upper sheet, over that of the fabric
UPPER = 1.0  # friction with the sheet above, over mu
OVER_LOWER = 0.5  # friction with the sheet below, over mu
SIDE = 0.1  # m
THICKNESS = 5e-4  # m
FABRIC = "gray-interlock"
SPEED = 0.01  # m/s
# The measurement of the force begins after this time [s].
SLIDING = 1.0
# The mean covers this time [s].
MEASURED = 0.4
ROUGH = 10.0  # friction of the floor
# Height by which held edges are lifted, in thicknesses. An edge that is held in contact could be
# pressed by any force.
LIFTED = 0.2
# Largest displacement of the lowest sheet [m].
LOWEST_MAX = 1e-5

# Share of a node's weight that is the unit of residuals.
FORCE_SHARE = 0.1


@dataclass(kw_only=True, eq=False)
class PullOut(MeshedProtocol):
    """The force that draws the middle of three sheets out, over the load between the upper two.

    Friction is mu between the upper two sheets, and mu/2 between the lower two. The master curve is
    mu + mu/2 (1 + weight of the middle sheet / load).
    """

    name = "pull-out"
    x_name = "mu"
    y_name = "force/load"
    points = "friction"
    parameters: ClassVar = {"load": "loads", "mesh": "meshes"}
    grids_max = 1
    thickness = THICKNESS
    constants: ClassVar = {
        "speed": SPEED,
        "friction_below_over_mu": OVER_LOWER,
        "force_scale_over_node_weight": FORCE_SHARE,
    }

    friction: Sequence[float] = FRICTION
    """Coefficients of friction mu."""
    loads: Sequence[float] = LOADS
    """Factors of the gravity on the upper sheet."""
    cells: int = 4
    """Number of cells along a side of the upper sheet."""
    tolerance: float = 0.005

    def measure(self, mu: float, at: Mapping[str, Any]) -> tuple[float, float]:
        pulled = Pulled(mu, at["load"], self.solver, self.cells, self.kinds[at["mesh"]])
        force = pulled.force()
        self.tally.count(pulled.cloth)
        return force


class Pulled:
    """Three sheets on a rough floor.

    A holder keeps the rear edge of the upper sheet in place. Another draws the front edge of the
    middle sheet.

    `mu` is the friction between the upper two sheets. `load` is a factor of the gravity on the
    upper sheet, which has `cells` cells along a side.
    """

    def __init__(
        self, mu: float, load: float, preset: SolverSettings, cells: int, kind: MeshKind
    ) -> None:
        self.mu = mu
        self.preset = preset
        # From the lowest sheet upwards. No edge of a sheet lies over an edge of another, and the
        # front edge of the middle sheet reaches out from under the upper sheet.
        sizes = (
            (1.5 * SIDE, 1.2 * SIDE),
            (1.25 * SIDE, SIDE),
            (SIDE, 0.9 * SIDE),
        )
        centres = (0.0, 0.1 * SIDE, 0.0)
        cell = SIDE / cells
        parts = [
            rectangle(width, length, (round(width / cell), round(length / cell)), cell, kind, level)
            for level, (width, length) in enumerate(sizes)
        ]
        laid = fabric(FABRIC)
        self.level = np.repeat([0, 1, 2], [len(part.rest) for part in parts])
        self.start = np.concatenate(
            [
                np.column_stack(
                    [
                        part.rest + np.array([centre, 0.0]),
                        np.full(len(part.rest), level * THICKNESS),
                    ]
                )
                for level, (part, centre) in enumerate(zip(parts, centres, strict=True))
            ]
        )
        x = self.start[:, 0]
        self.drawn = np.flatnonzero((self.level == 1) & (x > x[self.level == 1].max() - 1e-9))
        self.rear = np.flatnonzero((self.level == 2) & (x < x[self.level == 2].min() + 1e-9))
        self.start[np.concatenate([self.drawn, self.rear]), 2] += LIFTED * THICKNESS
        below = OVER_LOWER * mu
        above = UPPER * mu
        self.cloth = Cloth(
            meshes.together(*parts),
            laid,
            preset,
            held=np.concatenate([self.drawn, self.rear]),
            self_contact=SelfContact(
                [[mu, below, mu], [below, mu, above], [mu, above, mu]], THICKNESS
            ),
            force_scale=FORCE_SHARE * laid.density * parts[-1].spacing ** 2 * GRAVITY,
        )
        self.cloth.gravity[self.level == 2] *= load
        self.cloth.set_state(self.start)

    def force(self) -> tuple[float, float]:
        """Return the force on the middle sheet over the load, measured and of the master curve.

        The measured value is NaN if the lowest sheet moves.

        The load is the weight of the upper sheet minus the share that its holder bears. The weight
        of the middle sheet is reduced in the same way.
        """
        cloth = self.cloth
        dt = self.preset.time_step
        weight = -cloth.masses * cloth.gravity[:, 2]
        ends = self.start[cloth.held]
        forces = []
        loads = []
        rests = []
        for step in range(1, round((SLIDING + MEASURED) / dt) + 1):
            ends[: len(self.drawn), 0] = self.start[self.drawn, 0] + SPEED * step * dt
            cloth.step(dt, held=ends, bodies=[plane(ROUGH)])
            # The sheet has only begun to slide.
            if step * dt <= SLIDING:
                continue
            reactions = cloth.reactions
            forces.append(reactions[self.drawn, 0].sum())
            loads.append(weight[self.level == 2].sum() - reactions[self.rear, 2].sum())
            rests.append(weight[self.level == 1].sum() - reactions[self.drawn, 2].sum())
        load = float(np.mean(loads))
        rest = float(np.mean(rests))
        moved = np.abs(cloth.positions - self.start)[self.level == 0].max()
        force = float(np.mean(forces)) / load if moved < LOWEST_MAX else np.nan
        return force, UPPER * self.mu + OVER_LOWER * self.mu * (1.0 + rest / load)
