"""Bend-Twist: the weight at which a hanging curly rod leaves its plane [Miller et al. 2014; Romero et al. 2021].

Measured is the weight at which the rod solver's own certificate, a positive definite Hessian, is lost along a branch of
planar equilibria. An exactly planar rod stays planar, so there is nothing else to wait for.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stickslip_sim_core.protocols.rod_chain import (
    RodProtocol,
    extrapolated,
    loss_of_stability,
    planar_frames,
    round_rod,
)
from stickslip_sim_core.reference import master_curves

# Natural curvature times L [rad]: 6 ... 25 pi.
PHI = (6.0, 6.5, 7.0, 8.0, 10.0, 12.5, 16.0, 20.0, 27.0, 36.0, 48.0, 62.0, 25.0 * np.pi)
POISSON = (0.0, 0.3, 0.5)

# Branches are followed in these steps of gamma; close to the onset the three-dimensional window may be narrower than
# one of them. From above they start at gamma = phi^3, where every such rod hangs almost straight and stable, and end at
# gamma = 1e-4 phi^3, where all of it has curled up again.
DOWN = 0.9
DOWN_TO = 1e-4


@dataclass(kw_only=True, eq=False)
class BendTwist(RodProtocol):
    """The upper planar-to-3D boundary Gamma(phi), against `master_curves.bend_twist`."""

    name, x_name, y_name = "bend-twist", "phi", "Gamma"
    points, parameters = "phi", {"poisson": "poisson"}

    phi: Sequence[float] = PHI
    """Natural curvatures times L [rad]."""
    poisson: Sequence[float] = POISSON
    elements: int = 1024
    tolerance: float = 1e-4

    def measure(self, phi: float, at: Mapping[str, Any]) -> tuple[float, float]:
        boundary = extrapolated(lambda elements: upper_boundary(phi, at["poisson"], elements), self.elements)
        return boundary, float(master_curves.bend_twist(phi, at["poisson"]))


def upper_boundary(phi: float, poisson: float, elements: int) -> float:
    """Return the weight at which the planar chain, followed from large weights downwards, loses stability, or NaN."""
    relax = round_rod(phi, poisson)
    start = relax(phi**3, planar_frames(np.zeros(elements + 1)))
    if not start.stable:
        raise RuntimeError(f"bend-twist: the heavy rod of phi = {phi} is not stable on {elements} elements")
    steps = np.arange(1, np.ceil(np.log(DOWN_TO) / np.log(DOWN)))
    return loss_of_stability(relax, start, phi**3 * DOWN**steps)
