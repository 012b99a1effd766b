"""Cantilever of a rod: how far a heavy rod that is clamped horizontally hangs down."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip_sim_core.protocols.rod_chain import RodProtocol, extrapolated, planar_frames, round_rod, tip
from stickslip_sim_core.reference import master_curves

# Weights rho A g L^3 / EI [-]: 1e-3 ... 1e5.
GAMMA = tuple(float(g) for g in 10.0 ** np.arange(-3.0, 5.1, 0.5))

POISSON = 0.5  # twist does not enter


@dataclass(kw_only=True, eq=False)
class RodCantilever(RodProtocol):
    """H/W, drop of the tip over its horizontal reach, against `master_curves.cantilever`."""

    name, x_name, y_name = "rod-cantilever", "Gamma", "H/W"
    points = "gamma"

    gamma: Sequence[float] = GAMMA
    elements: int = 2048
    tolerance: float = 1e-4

    def measure(self, gamma: float, at: Mapping[str, Any]) -> tuple[float, float]:
        drop = extrapolated(lambda elements: drop_over_reach(gamma, elements), self.elements)
        return drop, float(master_curves.cantilever(gamma))


def drop_over_reach(gamma: float, elements: int) -> float:
    """Return H/W of a straight chain clamped horizontally, NaN if it finds no stable equilibrium."""
    straight = planar_frames(np.full(elements + 1, 0.5 * np.pi))
    hanging = round_rod(0.0, POISSON)(gamma, straight)
    if not hanging.stable:
        return np.nan
    x, y, z = tip(hanging.frames)
    return float(-z / np.hypot(x, y))
