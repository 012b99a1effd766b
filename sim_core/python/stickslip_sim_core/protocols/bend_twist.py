"""Bend-Twist: the weight at which a hanging curly rod leaves its plane [Miller et al. 2014; Romero et al. 2021].

Measured is the weight at which the rod solver's own certificate, a positive definite Hessian, is lost along a branch of
planar equilibria. An exactly planar rod stays planar, so there is nothing else to wait for.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np

from stickslip_sim_core import build_info
from stickslip_sim_core.protocols.result import Curve, ProtocolResult
from stickslip_sim_core.protocols.rod_chain import (
    check_elements,
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
UP = 1.05
UP_FROM = 1e-2


def run(
    *,
    phi: Sequence[float] = PHI,
    poisson: Sequence[float] = POISSON,
    elements: int = 1024,
    tolerance: float = 1e-4,
) -> ProtocolResult:
    """Measure the upper planar-to-3D boundary Gamma(phi) and compare it with `master_curves.bend_twist`."""
    check_elements(elements)
    curves = []
    for nu in poisson:
        measured = tuple(extrapolated(partial(upper_boundary, f, nu), elements) for f in phi)
        master = tuple(float(g) for g in master_curves.bend_twist(phi, nu))
        curves.append(Curve({"poisson": float(nu)}, tuple(float(f) for f in phi), measured, master))
    settings = {"elements": elements}
    return ProtocolResult("bend-twist", "phi", "Gamma", tuple(curves), tolerance, settings, build_info().build_hash)


def upper_boundary(phi: float, poisson: float, elements: int) -> float:
    """Return the weight at which the planar chain, followed from large weights downwards, loses stability, or NaN."""
    relax = round_rod(phi, poisson)
    start = relax(phi**3, planar_frames(np.zeros(elements + 1)))
    if not start.stable:
        raise RuntimeError(f"bend-twist: the heavy rod of phi = {phi} is not stable on {elements} elements")
    steps = np.arange(1, np.ceil(np.log(DOWN_TO) / np.log(DOWN)))
    return loss_of_stability(relax, start, phi**3 * DOWN**steps)


def lower_boundary(phi: float, poisson: float, elements: int) -> float:
    """Return the weight at which the planar chain, followed upwards from its natural shape, loses stability, or NaN."""
    relax = round_rod(phi, poisson)
    start = relax(UP_FROM, planar_frames(phi * np.linspace(0.0, 1.0, elements + 1)))
    if not start.stable:
        raise RuntimeError(f"bend-twist: the light rod of phi = {phi} is not stable on {elements} elements")
    steps = np.arange(1, np.ceil(np.log(phi**3 / UP_FROM) / np.log(UP)))
    return loss_of_stability(relax, start, UP_FROM * UP**steps)
