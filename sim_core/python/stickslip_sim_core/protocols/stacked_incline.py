"""Stacked incline: sheets lie on each other on a slope that grows; the interface of least friction slips, alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import SelfContact
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.inclined_plane import FABRIC, OnSlope, SlopeProtocol
from stickslip_sim_core.protocols.strip import MeshKind, rectangle

FRICTION = (0.1, 0.3, 0.8, 1.5)
SHEETS = (2, 4)
TOP, WIDER = 0.1, 0.01  # m: side of the sheet on top, and by how much each one below is wider on each side
THICKNESS = 5e-4  # m
ROUGHER = 1.5  # friction of all other interfaces, over the least


@dataclass(kw_only=True, eq=False)
class StackedIncline(SlopeProtocol):
    """The upper sheets of a stack, over the middle interface. The other interfaces are rougher than mu.

    A stack in which another interface slides has no slip angle either.
    """

    name, force_share, thickness = "stacked-incline", 0.1, THICKNESS
    parameters: ClassVar = {"sheets": "sheets", "mesh": "meshes"}

    friction: Sequence[float] = FRICTION
    sheets: Sequence[int] = SHEETS
    """Numbers of sheets, at least 2 each."""
    cells: int = 4
    """Of the sheet on top along a side; the others have cells of about that size."""
    tolerance: float = 0.002

    def lay(self, mu: float, at: Mapping[str, Any]) -> "Stack":
        return Stack(at["sheets"], mu, self.solver, self.cells, self.kinds[at["mesh"]])


class Stack(OnSlope):
    """Sheets on each other on a slope, the widest below, with the least friction, mu, below sheet `sheets // 2`.

    `cells` are those of the sheet on top along a side.
    """

    share_from, share_to, rate, slid = 0.99, 1.01, 0.002, 1e-6

    def __init__(
        self, sheets: int, mu: float, preset: SolverSettings, cells: int, kind: MeshKind = "alternating"
    ) -> None:
        if sheets < 2:
            raise ValueError(f"sheets: must be at least 2, got {sheets}")
        loose = sheets // 2
        parts = []
        for level in range(sheets):
            side = TOP + 2.0 * WIDER * (sheets - 1 - level)
            count = round(side / TOP * cells)
            parts.append(rectangle(side, side, (count, count), TOP / cells, kind, level))
        friction = np.full((sheets, sheets), ROUGHER * mu)
        friction[loose - 1, loose] = friction[loose, loose - 1] = mu
        laid = fabric(FABRIC)
        weight = laid.density * parts[-1].spacing ** 2 * GRAVITY
        cloth = Cloth(
            meshes.together(*parts),
            laid,
            preset,
            self_contact=SelfContact(friction, THICKNESS),
            force_scale=StackedIncline.force_share * weight,
        )
        start = np.concatenate(
            [np.column_stack([p.rest, np.full(len(p.rest), level * THICKNESS)]) for level, p in enumerate(parts)]
        )
        self.level = np.repeat(np.arange(sheets), [len(p.rest) for p in parts])
        super().__init__(cloth, start, mu, ROUGHER * mu, self.level >= loose)
