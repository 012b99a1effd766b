"""Cantilever: the sag of a strip of cloth that is clamped horizontally [Romero et al. 2021]."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, RESIDUAL_PATCH, Cloth
from stickslip_sim_core.protocols.protocol import LENGTH, RefinedProtocol, Strip, cell_of, strip
from stickslip_sim_core.reference import master_curves

# Weights rho_A g L^3 / D [-].
GAMMA = (0.01, 0.1, 1.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
FINER = {30.0: 2, 300.0: 5}
"""Factors by which meshes are finer beyond these weights: the strip bends within a few cells."""

# Without Poisson's effect the width does not matter.
CELLS_ACROSS = 2

DENSITY = 0.2  # kg/m^2

# Stiffness against stretching, over rho_A g L. The strip stretches by at most half of its inverse.
# With ten times this stiffness, an unstructured mesh of flat triangles begins to lock at the sharp
# bend of heavy strips.
STRETCHING = 3e3

DAMPING = 3.0  # 1/s
# Number of steps with the preset's length, before steps grow.
STEADY_STEPS = 60
GROWTH = 1.2  # ratio of a time step to the step before
LONGEST = 1.0  # time step [s]
STEPS_MAX = 600
# Share of the length: the strip is at rest if no vertex moves further in a long step.
REST = 2e-5
# Share of the weight of 25 mm^2 that is the unit of residuals where meshes are not finer. Forces of
# bending at a node do not become smaller with its weight, and single precision of the matrix bounds
# how exactly those of stiff strips are solved.
FORCE_SHARE = 0.1


@dataclass(kw_only=True, eq=False)
class Cantilever(RefinedProtocol):
    """H/W, drop of the tip over its horizontal reach, against `master_curves.cantilever`.

    The preset's time step is the first one. Steps grow to 1 s as the strip settles.
    """

    name = "cantilever"
    x_name = "Gamma"
    y_name = "H/W"
    points = "gamma"
    time_step_name = "first_time_step"
    constants: ClassVar = {
        "last_time_step_at_most": LONGEST,
        **{f"finer_beyond_{weight:g}": times for weight, times in FINER.items()},
        "stretching_over_weight": STRETCHING,
        "force_scale_over_weight_of_25_mm2": FORCE_SHARE,
    }

    gamma: Sequence[float] = GAMMA
    """Weights rho_A g L^3 / D."""
    unstructured: int = 2

    def finer(self, x: float) -> int:
        return finer(x)

    def measure_with(self, cells: int, x: float, at: Mapping[str, Any]) -> float:
        ratio, cloth = hang(
            strip(CELLS_ACROSS * cell_of(cells), cells, self.kinds[at["mesh"]]), x, self.solver
        )
        self.tally.count(cloth)
        return ratio

    def master(self, x: float, at: Mapping[str, Any]) -> float:
        return float(master_curves.cantilever(x))


def finer(gamma: float) -> int:
    """Return the factor by which meshes are finer for a weight, and residuals smaller."""
    return max((times for weight, times in FINER.items() if gamma > weight), default=1)


def hang(
    clamped: Strip,
    gamma: float,
    preset: SolverSettings,
    stretching: float = STRETCHING,
    softening: float | None = None,
) -> tuple[float, Cloth]:
    """Let a strip that starts straight and horizontal settle, and return H/W and the cloth.

    H/W is NaN if the strip did not come to rest. For `softening` see `Fabric`. The scheme of time
    has no part in the answer, so it is always the one of first order, which long steps damp.
    """
    weight = DENSITY * GRAVITY * LENGTH  # N/m
    laid = isotropic(DENSITY, stretching * weight, weight * LENGTH**2 / gamma)
    cloth = Cloth(
        clamped.mesh,
        replace(laid, softening=softening),
        replace(preset, second_order=False),
        held=clamped.held,
        force_scale=FORCE_SHARE / finer(gamma) * DENSITY * GRAVITY * RESIDUAL_PATCH,
    )
    straight = np.stack([clamped.along, clamped.across, np.zeros_like(clamped.along)], axis=1)
    cloth.set_state(straight)
    held = clamped.held
    dt = preset.time_step
    at_rest = False
    while cloth.total.steps < STEPS_MAX and not at_rest:
        before = cloth.positions
        cloth.step(dt, held=straight[held], damping=DAMPING)
        # Rest counts only in a long step: in a short one, a slow strip hardly moves either.
        at_rest = (
            2.0 * dt > LONGEST and float(np.abs(cloth.positions - before).max()) < REST * LENGTH
        )
        # The scheme damps more in longer steps, which bring the strip to rest sooner.
        if cloth.total.steps > STEADY_STEPS:
            dt = min(dt * GROWTH, LONGEST)
    reach, _, drop = cloth.positions[clamped.tip].mean(axis=0)
    return float(-drop / reach) if at_rest else np.nan, cloth
