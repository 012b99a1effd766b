"""Cantilever of a strip whose rigidity falls with curvature."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from stickslip_sim_core.protocols.cantilever import CELLS_ACROSS, Cantilever, hang
from stickslip_sim_core.protocols.protocol import LENGTH, cell_of, strip
from stickslip_sim_core.reference.soft_cantilever import soft_cantilever

GAMMA = (3.0, 10.0, 30.0)
SOFTENING = (50.0, 16.0)
"""Curvatures of softening, times the length of 0.1 m: 500 and 160 /m.

With the second one the heaviest strip bends beyond the corner of the law.
"""


@dataclass(kw_only=True, eq=False)
class SoftCantilever(Cantilever):
    """H/W of a strip that softens, drop of the tip over its horizontal reach.

    The strip and its rest are those of `Cantilever`.
    """

    name = "soft-cantilever"
    parameters: ClassVar = {"softening": "softening", "mesh": "meshes"}

    gamma: Sequence[float] = GAMMA
    softening: Sequence[float] = SOFTENING
    """Curvatures of softening times the length, k_s L."""
    unstructured: int = 1
    tolerance: float = 2e-3
    # The corner of the law makes the convergence of strips that bend beyond it uneven.
    limit_tolerance: float = 2e-3

    def measure_with(self, cells: int, x: float, at: Mapping[str, Any]) -> float:
        laid = strip(CELLS_ACROSS * cell_of(cells), cells, self.kinds[at["mesh"]])
        ratio, cloth = hang(laid, x, self.solver, softening=at["softening"] / LENGTH)
        self.tally.count(cloth)
        return ratio

    def master(self, x: float, at: Mapping[str, Any]) -> float:
        return soft_cantilever(x, at["softening"])
