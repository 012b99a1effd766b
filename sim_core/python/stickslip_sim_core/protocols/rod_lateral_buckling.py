"""Lateral buckling in the limit of a rod: the weight at which a strip clamped edge-on buckles sideways.

Measured is the loss of the rod solver's certificate, a positive definite Hessian, as the weight of a strip grows that
stays in its vertical plane. The limit of a strip that does not bend in its own plane is reached by extrapolation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from stickslip_sim_core import _sim_core
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.protocols.rod_chain import (
    Equilibrium,
    Relax,
    RodProtocol,
    extrapolated,
    loss_of_stability,
    planar_frames,
)
from stickslip_sim_core.reference import master_curves

POISSON = (0.0, 0.3, 0.5)

# Bending stiffness in the strip's plane over that across it; the buckling weight is a power series in its inverse.
STIFFNESS_RATIOS = (1000.0, 2000.0, 4000.0)

# The weight over sqrt(EI GJ) grows from half of what buckles a strip, in these steps.
UP_FROM = 6.0
UP = 1.1
UP_TO = 60.0


@dataclass(kw_only=True, eq=False)
class RodLateralBuckling(RodProtocol):
    """The weight rho A g L^3 / sqrt(EI GJ) at buckling, against `master_curves.lateral_buckling_rod`."""

    name, x_name, y_name = "rod-lateral-buckling", "poisson", "rho A g L^3 / sqrt(EI GJ)"
    points = "poisson"

    poisson: Sequence[float] = POISSON
    elements: int = 128
    tolerance: float = 1e-4

    def measure(self, poisson: float, at: Mapping[str, Any]) -> tuple[float, float]:
        return rigid_limit(poisson, self.elements), master_curves.lateral_buckling_rod()

    def reported(self) -> dict[str, Setting]:
        return super().reported() | {"stiffness_ratios": STIFFNESS_RATIOS}


def rigid_limit(poisson: float, elements: int) -> float:
    """Return the buckling weight of a continuous strip, rigid in its plane."""
    single, double, fourfold = (
        extrapolated(partial(buckling_weight, poisson, ratio), elements) for ratio in STIFFNESS_RATIOS
    )
    return (8.0 * fourfold - 6.0 * double + single) / 3.0


def buckling_weight(poisson: float, stiffness_ratio: float, elements: int) -> float:
    """Return rho A g L^3 / sqrt(EI GJ) at which the chain of a strip loses stability, NaN if it never does."""
    # A thin strip: EI = Y w t^3 / 12 across its plane, GJ = Y w t^3 / (6 (1 + poisson)).
    twist = 2.0 / (1.0 + poisson)
    relax = strip(twist, stiffness_ratio, elements)
    horizontal = planar_frames(np.full(elements + 1, 0.5 * np.pi))
    start = relax(UP_FROM * np.sqrt(twist), horizontal)
    if not start.stable:
        return np.nan
    steps = np.arange(1, np.ceil(np.log(UP_TO / UP_FROM) / np.log(UP)))
    return loss_of_stability(relax, start, start.gamma * UP**steps) / float(np.sqrt(twist))


def strip(twist_stiffness: float, stiffness_ratio: float, elements: int) -> Relax:
    """Relax chains of a straight strip; d3 = -y is the axis it hardly bends about."""
    stiffness = np.array([twist_stiffness, 1.0, stiffness_ratio])
    straight = np.zeros((elements, 3))

    def relax(gamma: float, frames: Floats) -> Equilibrium:
        at_rest, _, _, stable = _sim_core.relax_chain(gamma, stiffness, straight, frames)
        return Equilibrium(gamma, at_rest, stable)

    return relax
