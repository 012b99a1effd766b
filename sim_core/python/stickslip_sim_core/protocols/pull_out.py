"""Pull-out: a sheet is drawn out from between two others under a dead load; friction of both sides adds up."""

from collections.abc import Sequence

import numpy as np

from stickslip_sim_core import build_info
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth, SelfContact
from stickslip_sim_core.protocols.result import Curve, ProtocolResult

FRICTION = (0.1, 0.3, 0.8, 1.5)
ABOVE = 0.5
"""Friction above the sheet over that below it."""

LOAD = 5.0
"""Weight of the sheet on top over that of the fabric."""

SIDE, WIDTH = 0.1, 0.08  # m: of the sheet on top, along the pull and across
LONGER, WIDER = 0.02, 0.01  # m: by how much the drawn sheet sticks out, and is wider, and the one below in turn
THICKNESS, LIFTED = 5e-4, 1e-5
"""Of the sheets, and how far the drawn edge is held above the sheet below, which would carry it else [m]."""

FABRIC = "gray-interlock"

SPEED = 1e-3  # m/s
STEADY = 1e-4
"""The pull has become steady when it changes by less than this share over `SPAN`."""

SPAN, AT_MOST = 0.25, 10.0  # s

FORCE_SHARE = 0.1  # of a node's weight: the force that residuals are measured in


def run(
    *,
    preset: str | SolverSettings = "certified",
    friction: Sequence[float] = FRICTION,
    cells: int = 8,
    structured: int = 1,
    unstructured: int = 1,
    tolerance: float = 0.005,
) -> ProtocolResult:
    """Measure the force that draws out a sheet, and compare it with Coulomb's.

        F = mu_below (N + W) + mu_above N

    N is the weight of the sheet on top, and W that of the drawn one. A pull that does not become steady is NaN.

    Args:
        preset: Solver settings, or their name.
        friction: Of the drawn sheet with the one below; with the one above it is `ABOVE` times that.
        cells: Of the meshes along `SIDE`.
        structured: Number of structured meshes, 0 or 1.
        unstructured: Number of unstructured ones.
        tolerance: Largest |relative error| that passes.
    """
    settings = preset_named(preset)
    seeds = [None] * structured + list(range(unstructured))
    curves, unconverged = [], 0
    for number, seed in enumerate(seeds):
        measured, exact = [], []
        for mu in friction:
            sheets = Sheets(mu, settings, cells, seed)
            measured.append(sheets.pull())
            exact.append(sheets.master)
            unconverged += sheets.cloth.unconverged_steps
        x = tuple(float(mu) for mu in friction)
        curves.append(Curve({"mesh": float(number)}, x, tuple(measured), tuple(exact)))
    return ProtocolResult(
        "pull-out",
        "mu below",
        "force [N]",
        tuple(curves),
        tolerance,
        {
            "preset": settings.name,
            "time_step": settings.time_step,
            "cells": cells,
            "meshes": ", ".join("grid" if seed is None else f"unstructured {seed}" for seed in seeds),
            "mu_above_over_below": ABOVE,
            "load_over_weight": LOAD,
            "force_scale_over_node_weight": FORCE_SHARE,
            "unconverged_steps": unconverged,
        },
        build_info().build_hash,
    )


class Sheets:
    """Three sheets on each other: the lowest held everywhere, the others held at opposite edges that stick out.

    Args:
        mu: Friction below the drawn sheet.
        preset: Solver settings.
        cells: Of the meshes along `SIDE`.
        seed: Of unstructured meshes; None: grids.
    """

    def __init__(self, mu: float, preset: SolverSettings, cells: int, seed: int | None = None) -> None:
        self.preset = preset
        spacing = SIDE / cells
        lengths = (SIDE + 4.0 * LONGER, SIDE + LONGER, SIDE + LONGER)
        centres = (0.0, 0.5 * LONGER, -0.5 * LONGER)
        parts = []
        for number, length in enumerate(lengths):
            width = WIDTH + (2 - number) * WIDER
            if seed is None:
                parts.append(meshes.grid(length, width, round(length / spacing), round(width / spacing)))
            else:
                parts.append(meshes.unstructured(length, width, spacing, seed + number))
        flat = [
            np.column_stack([part.rest + np.array([centre, 0.0]), np.full(len(part.rest), number * THICKNESS)])
            for number, (part, centre) in enumerate(zip(parts, centres, strict=True))
        ]
        self.start = np.concatenate(flat)
        level = np.repeat([0, 1, 2], [len(part.rest) for part in parts])
        drawn = (level == 1) & (self.start[:, 0] > SIDE / 2.0 + LONGER - 1e-9)
        kept = (level == 0) | ((level == 2) & (self.start[:, 0] < -SIDE / 2.0 - LONGER + 1e-9))
        held = np.flatnonzero(drawn | kept)
        self._pulled = drawn[held]
        self.start[drawn, 2] += LIFTED
        self._ends = self.start[held]
        laid = fabric(FABRIC)
        friction = np.zeros((3, 3))
        friction[0, 1] = friction[1, 0] = mu
        friction[1, 2] = friction[2, 1] = ABOVE * mu
        self.cloth = Cloth(
            meshes.together(*parts),
            laid,
            preset,
            held=held,
            self_contact=SelfContact(friction, THICKNESS),
            force_scale=FORCE_SHARE * laid.density * spacing**2 * GRAVITY,
        )
        self.cloth.set_state(self.start)
        # Where the top sheet reaches over the end of the drawn one, to where it is held, it has no weight.
        over = self.start[:, 0] > -SIDE / 2.0 + LONGER / 2.0
        self.cloth.gravity[level == 2] *= np.where(over[level == 2], LOAD, 0.0)[:, None]
        weight = -self.cloth.masses * self.cloth.gravity[:, 2]
        load, own = (float(weight[(level == n) & ~drawn & ~kept].sum()) for n in (2, 1))
        self.master = mu * (load + own) + ABOVE * mu * load
        """Force that draws it out [N]."""

    def pull(self) -> float:
        """Return the force that draws the sheet out once it is steady [N], or NaN."""
        dt = self.preset.time_step
        span, forces = round(SPAN / dt), []
        for step in range(1, round(AT_MOST / dt) + 1):
            ends = self._ends.copy()
            ends[self._pulled, 0] += SPEED * dt * step
            self.cloth.step(dt, held=ends)
            forces.append(float(self.cloth.reactions[self.cloth.held[self._pulled], 0].sum()))
            last = forces[-span:]
            if len(forces) > span and max(last) - min(last) < STEADY * abs(last[-1]):
                return float(np.mean(last))
        return float("nan")
