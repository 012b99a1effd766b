"""Pull-out: a sheet is drawn out from between two others that lie under a load.

Both of its sides rub.
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
SLIDING = 1.0  # s: after which the force is measured
MEASURED = 0.4  # s: over which its mean is taken
ROUGH = 10.0  # friction of the floor
# thicknesses: by which held edges are lifted; held where they touch, they could be pressed by any
# force
LIFTED = 0.2
LOWEST_MAX = 1e-5  # m: by which the lowest sheet may move

# Of a node's weight: the force that residuals are measured in.
FORCE_SHARE = 0.1


@dataclass(kw_only=True, eq=False)
class PullOut(MeshedProtocol):
    """The force that draws the middle of three sheets out, over the load between the upper two.

    Friction is mu between the upper two, and mu/2 between the lower two. The master curve is
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
    """mu."""
    loads: Sequence[float] = LOADS
    """Factors of the gravity on the upper sheet."""
    cells: int = 4
    """Of the upper sheet along a side."""
    tolerance: float = 0.005

    def measure(self, mu: float, at: Mapping[str, Any]) -> tuple[float, float]:
        pulled = Pulled(mu, at["load"], self.solver, self.cells, self.kinds[at["mesh"]])
        found = pulled.force()
        self.tally.count(pulled.cloth)
        return found


class Pulled:
    """Three sheets on a rough floor.

    The upper one is held by its rear edge, the middle one drawn by its front edge.

    `mu` is the friction of the upper two, `load` a factor of the gravity on the upper one, which
    has `cells` a side.
    """

    def __init__(
        self, mu: float, load: float, preset: SolverSettings, cells: int, kind: MeshKind
    ) -> None:
        self.mu = mu
        self.preset = preset
        sizes = (
            (1.5 * SIDE, 1.2 * SIDE),
            (1.25 * SIDE, SIDE),
            (SIDE, 0.9 * SIDE),
        )  # from the lowest upwards
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
        """Return the force that draws the middle sheet over the load, and the master curve's.

        The force is NaN if the lowest sheet moves.

        The load is what the holders of the upper sheet leave of its weight, and likewise for the
        middle one.
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
