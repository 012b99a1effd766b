"""Cantilever: how far a strip of cloth that is clamped horizontally hangs down [Romero et al. 2021]."""

from collections.abc import Sequence

import numpy as np

from stickslip_sim_core import build_info
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.result import Curve, ProtocolResult
from stickslip_sim_core.protocols.strip import LENGTH, Strip, strips
from stickslip_sim_core.reference import master_curves

# Weights rho_A g L^3 / D [-].
GAMMA = (0.01, 0.1, 1.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
HEAVY = 300.0
"""Beyond this weight the mesh is twice as fine: the strip bends within a few cells."""

WIDTH = 0.02  # m
DENSITY = 0.2  # kg/m^2

# Stiffness against stretching, over rho_A g L: the strip stretches by half of its inverse at most. Ten times as much
# and an unstructured mesh of flat triangles begins to lock at the sharp bend of heavy strips.
STRETCHING = 3e3

DAMPING = 3.0  # 1/s
STEADY_STEPS = 60  # of the preset's length; then they grow
GROWTH, LONGEST = 1.2, 1.0  # s
STEPS_MAX = 600
REST = 2e-5  # of the length: a long step in which nothing moves by more is the last
FORCE_SHARE = 0.1  # of a node's weight: the force that residuals are measured in


def run(
    *,
    preset: str | SolverSettings = "certified",
    gamma: Sequence[float] = GAMMA,
    cells: int = 50,
    structured: int = 1,
    unstructured: int = 5,
    tolerance: float = 0.01,
) -> ProtocolResult:
    """Measure H/W, drop of the tip over its horizontal reach, and compare it with `master_curves.cantilever`.

    Args:
        preset: Solver settings, or their name. Its time step is the first one; steps grow to 1 s as the strip settles.
        gamma: Weights rho_A g L^3 / D.
        cells: Of a mesh along the strip, up to `HEAVY`; twice as many beyond.
        structured: Number of structured meshes, 0 ... 4.
        unstructured: Number of unstructured ones.
        tolerance: Largest |relative error| that passes.
    """
    settings = preset_named(preset)
    master = tuple(float(v) for v in master_curves.cantilever(gamma)) if len(gamma) else ()
    curves, names, steps, unconverged = [], [], 0, 0
    pairs = zip(
        strips(WIDTH, cells, structured, unstructured), strips(WIDTH, 2 * cells, structured, unstructured), strict=True
    )
    for number, (light, heavy) in enumerate(pairs):
        measured = []
        for weight in gamma:
            ratio, cloth = hang(heavy if weight > HEAVY else light, weight, settings)
            measured.append(ratio)
            steps += cloth.steps
            unconverged += cloth.unconverged_steps
        curves.append(Curve({"mesh": float(number)}, tuple(float(g) for g in gamma), tuple(measured), master))
        names.append(f"{number} {light.name}")
    return ProtocolResult(
        "cantilever",
        "Gamma",
        "H/W",
        tuple(curves),
        tolerance,
        {
            "preset": settings.name,
            "first_time_step": settings.time_step,
            "last_time_step_at_most": LONGEST,
            "cells": cells,
            f"cells_beyond_{HEAVY:g}": 2 * cells,
            "meshes": ", ".join(names),
            "stretching_over_weight": STRETCHING,
            "force_scale_over_node_weight": FORCE_SHARE,
            "steps": steps,
            "unconverged_steps": unconverged,
        },
        build_info().build_hash,
    )


def hang(strip: Strip, gamma: float, preset: SolverSettings, stretching: float = STRETCHING) -> tuple[float, Cloth]:
    """Let a strip that was straight and horizontal settle; return H/W, NaN if it did not, and the cloth."""
    weight = DENSITY * GRAVITY * LENGTH  # N/m
    cloth = Cloth(
        strip.mesh,
        isotropic(DENSITY, stretching * weight, weight * LENGTH**2 / gamma),
        preset,
        held=strip.held,
        clamped=strip.clamped,
        force_scale=FORCE_SHARE * DENSITY * GRAVITY * strip.mesh.spacing**2,
    )
    straight = np.stack([strip.along, strip.across, np.zeros_like(strip.along)], axis=1)
    cloth.set_state(straight, None, np.tile([-1.0, 0.0, 0.0], (len(strip.clamped), 1)))
    dt, at_rest = preset.time_step, False
    while cloth.steps < STEPS_MAX and not at_rest:
        before = cloth.positions
        cloth.step(dt, held=straight[strip.held], damping=DAMPING)
        at_rest = 2.0 * dt > LONGEST and float(np.abs(cloth.positions - before).max()) < REST * LENGTH
        if cloth.steps > STEADY_STEPS:
            dt = min(dt * GROWTH, LONGEST)
    reach, _, drop = cloth.positions[strip.tip].mean(axis=0)
    return float(-drop / reach) if at_rest else np.nan, cloth
