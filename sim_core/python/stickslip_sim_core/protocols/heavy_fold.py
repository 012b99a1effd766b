"""Heavy fold: a strip that is folded onto itself lies on a floor; its loop has one shape, whatever friction is."""

from collections.abc import Sequence

import numpy as np

from stickslip_sim_core import build_info
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth, SelfContact, plane
from stickslip_sim_core.protocols.result import Curve, ProtocolResult
from stickslip_sim_core.reference import master_curves

BENDING_LENGTH = 0.02  # L_gb, m
DENSITY = 0.2  # kg/m^2
GAP = 1.0 / 16.0  # thickness over L_gb
STRETCHING = 1.5e4  # over rho g L_gb
LOWER, UPPER = 4.0, 3.0  # length of the layers that lie, over L_gb
FRICTION = (0.3, 1.0)

# Settling: steps grow from the preset's tenth to this one [s], with a damping [1/s], until nothing moves further [m].
FIRST_SHARE, GROWTH, LONGEST, DAMPING, REST = 0.1, 1.1, 0.05, 8.0, 1e-9
STEPS_MAX = 1500
HOLD_TIME = 10.0  # s: over which drift is measured

# Of a node's weight: the force that residuals are measured in.
FORCE_SHARE = 0.1


def run(
    *,
    preset: str | SolverSettings = "certified",
    friction: Sequence[float] = FRICTION,
    cells: int = 120,
    tolerance: float = 0.005,
) -> ProtocolResult:
    """Measure the height of the loop and how far its nose lies before the landing, over L_gb.

    Args:
        preset: Solver settings, or their name.
        friction: Of the strip with itself and with the floor; the master curves do not depend on it.
        cells: Of the strip along its length, which is 11.7 L_gb.
        tolerance: Largest |relative error| that passes.
    """
    settings = preset_named(preset)
    exact = master_curves.heavy_fold(GAP)
    measured, drift, least, steps, unconverged = [], 0.0, np.inf, 0, 0
    for mu in friction:
        fold = Fold(mu, settings, cells)
        measured.append(fold.settle())
        drift = max(drift, fold.drift())
        least = min(least, fold.cloth.least_distance)
        steps, unconverged = steps + fold.cloth.steps, unconverged + fold.cloth.unconverged_steps
    x = tuple(float(mu) for mu in friction)
    return ProtocolResult(
        "heavy-fold",
        "mu",
        "length/L_gb",
        tuple(
            Curve({"what": float(row)}, x, tuple(one[row] for one in measured), (master,) * len(x))
            for row, master in enumerate((exact.height, exact.nose_to_landing))
        ),
        tolerance,
        {
            "preset": settings.name,
            "what": "0 height, 1 nose to landing",
            "cells": cells,
            "gap_over_bending_length": GAP,
            "stretching_over_weight": STRETCHING,
            "force_scale_over_node_weight": FORCE_SHARE,
            "last_time_step_at_most": LONGEST,
            "drift_mm": 1e3 * drift,
            "drift_seconds": HOLD_TIME,
            "least_distance_over_thickness": least / (GAP * BENDING_LENGTH),
            "steps": steps,
            "unconverged_steps": unconverged,
        },
        build_info().build_hash,
    )


class Fold:
    """A strip on a floor, with its upper part folded back over the lower one.

    Args:
        mu: Friction with itself and with the floor.
        preset: Solver settings.
        cells: Along its length.
    """

    def __init__(self, mu: float, preset: SolverSettings, cells: int) -> None:
        loop = master_curves.heavy_fold(GAP).loop_length
        length = (LOWER + loop + UPPER) * BENDING_LENGTH
        cell = length / cells
        mesh = strip_of(cell, cells)
        weight = DENSITY * GRAVITY * BENDING_LENGTH  # N/m
        self.cloth = Cloth(
            mesh,
            isotropic(DENSITY, STRETCHING * weight, weight * BENDING_LENGTH**2),
            preset,
            self_contact=SelfContact(mu, GAP * BENDING_LENGTH),
            force_scale=FORCE_SHARE * DENSITY * cell**2 * GRAVITY,
        )
        self.along = mesh.rest[:, 1]
        self.middle = np.flatnonzero(np.abs(mesh.rest[:, 0]) < 1e-3 * cell)
        self.landing_from = (LOWER + 0.7 * loop) * BENDING_LENGTH
        self.floor = [plane(mu)]
        self.step = FIRST_SHARE * preset.time_step
        # It begins as a straight part, a half circle and a straight part back.
        radius = 0.45 * BENDING_LENGTH
        bend = LOWER * BENDING_LENGTH + 0.5 * (loop * BENDING_LENGTH - np.pi * radius)
        angle = np.clip((self.along - bend) / radius, 0.0, np.pi)
        beyond = np.maximum(self.along - bend - np.pi * radius, 0.0)
        x = np.minimum(self.along, bend) + radius * np.sin(angle) - beyond
        self.cloth.set_state(np.column_stack([x, mesh.rest[:, 0], radius * (1.0 - np.cos(angle))]))

    def settle(self) -> tuple[float, float]:
        """Return height and distance of nose and landing over L_gb; NaN if it does not come to rest."""
        for _ in range(STEPS_MAX):
            before = self.cloth.positions
            self.cloth.step(self.step, bodies=self.floor, damping=DAMPING)
            moved = np.abs(self.cloth.positions - before).max()
            if self.step == LONGEST and moved < REST:
                return self.measure()
            self.step = min(GROWTH * self.step, LONGEST)
        return np.nan, np.nan

    def drift(self) -> float:
        """Return how far any vertex comes in `HOLD_TIME` without damping [m]."""
        before = self.cloth.positions
        for _ in range(round(HOLD_TIME / LONGEST)):
            self.cloth.step(LONGEST, bodies=self.floor)
        return float(np.abs(self.cloth.positions - before).max())

    def measure(self) -> tuple[float, float]:
        """Return height and distance of nose and landing over L_gb.

        Beyond the landing the layer below bears the weight of each vertex, and there a force besides. It is where the
        surplus over the weights has its centre, since the layer bears no moment.
        """
        at = self.cloth.positions
        line = at[self.middle][np.argsort(self.along[self.middle])]
        height, nose = peak(line[:, 2]), peak(line[:, 0])
        pairs = self.cloth.pair_forces
        lift = np.zeros(len(at))
        np.add.at(lift, pairs.vertices, pairs.weights * pairs.forces[:, None, 2])
        lies = (self.along > self.landing_from) & (lift > 0.0)
        surplus = lift[lies] - self.cloth.masses[lies] * GRAVITY
        landing = surplus @ at[lies, 0] / surplus.sum()
        return height / BENDING_LENGTH, float(nose - landing) / BENDING_LENGTH


def strip_of(cell: float, cells: int) -> meshes.Mesh:
    """Return a strip of equilateral triangles from y = 0 on, two rows wide: they leave most room for a thickness."""
    rise, side, inner = np.sqrt(0.75) * cell, cell * np.arange(cells + 1), cell * (np.arange(cells) + 0.5)
    rest = [np.column_stack([np.full(len(y), x), y]) for x, y in ((-rise, side), (0.0, inner), (rise, side))]
    left, middle = np.arange(cells + 1), cells + 1 + np.arange(cells)
    right = left + 2 * cells + 1
    triangles = [
        np.column_stack([left[:-1], middle, left[1:]]),
        np.column_stack([left[1:-1], middle[:-1], middle[1:]]),
        np.column_stack([right[:-1], right[1:], middle]),
        np.column_stack([right[1:-1], middle[1:], middle[:-1]]),
    ]
    return meshes.Mesh(np.concatenate(rest), np.concatenate(triangles).astype(np.int32))


def peak(values: np.ndarray) -> float:
    """Return the maximum of the parabola through the largest value and its neighbours."""
    i = int(np.argmax(values))
    before, top, after = values[i - 1 : i + 2]
    return float(top + (after - before) ** 2 / (8.0 * (2.0 * top - before - after)))
