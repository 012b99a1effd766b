"""Cantilever of a rod: how far a heavy rod that is clamped horizontally hangs down."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from stickslip_sim_core import build_info
from stickslip_sim_core.protocols.result import Curve, ProtocolResult
from stickslip_sim_core.protocols.rod_chain import check_elements, extrapolated, planar_frames, round_rod, tip
from stickslip_sim_core.reference import master_curves

# Weights rho A g L^3 / EI [-]: 1e-3 ... 1e5.
GAMMA = tuple(float(g) for g in 10.0 ** np.arange(-3.0, 5.1, 0.5))

POISSON = 0.5  # twist does not enter


def run(*, gamma: Sequence[float] = GAMMA, elements: int = 2048, tolerance: float = 1e-4) -> ProtocolResult:
    """Measure H/W, drop of the tip over its horizontal reach, and compare it with `master_curves.cantilever`."""
    check_elements(elements)
    measured = tuple(extrapolated(partial(drop_over_reach, g), elements) for g in gamma)
    master = tuple(float(ratio) for ratio in master_curves.cantilever(gamma))
    curve = Curve({}, tuple(float(g) for g in gamma), measured, master)
    settings = {"elements": elements}
    return ProtocolResult("rod-cantilever", "Gamma", "H/W", (curve,), tolerance, settings, build_info().build_hash)


def drop_over_reach(gamma: float, elements: int) -> float:
    """Return H/W of a straight chain clamped horizontally, NaN if it finds no stable equilibrium."""
    straight = planar_frames(np.full(elements + 1, 0.5 * np.pi))
    hanging = round_rod(0.0, POISSON)(gamma, straight)
    if not hanging.stable:
        return np.nan
    x, y, z = tip(hanging.frames)
    return float(-z / np.hypot(x, y))
