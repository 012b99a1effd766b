"""Heavy fold: a strip folded onto itself lies on a floor.

The shape of its loop does not depend on friction. The upper layer is then pulled away from the loop
until it slips.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import SelfContact, plane
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.protocol import ClothProtocol
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.reference import master_curves

BENDING_LENGTH = 0.02  # L_gb, m
DENSITY = 0.2  # kg/m^2
GAP = 1.0 / 16.0  # thickness over L_gb
STRETCHING = 1.5e4  # over rho g L_gb
LOWER = 4.0  # lying length of the lower layer, over L_gb
UPPER = 3.0  # lying length of the upper layer, over L_gb
FRICTION = (0.3, 1.0)

# The strip settles with a damping [1/s]. Steps grow from a tenth of the preset's to LONGEST [s],
# until no vertex moves further than REST [m] in a step.
FIRST_SHARE = 0.1
GROWTH = 1.1
LONGEST = 0.05
DAMPING = 8.0
REST = 1e-9
STEPS_MAX = 1500

# The pull on the upper layer, over the pull of the master curve. It grows to HOLD_SHARE while the
# strip is damped, and stays there for HOLD_TIME [s] for the measurement of drift. From FROM to
# UP_TO it grows slowly, by RATE [1/s].
HOLD_SHARE = 0.9
HOLD_TIME = 10.0
FROM = 0.98
UP_TO = 1.02
RATE = 0.004
GROWING = 1.0  # s
# The upper layer slips if all of its vertices have moved this far [m].
MOVED = 1e-6

# Share of a node's weight that is the unit of residuals.
FORCE_SHARE = 0.1


@dataclass(kw_only=True, eq=False)
class HeavyFold(ClothProtocol):
    """The shape of a heavy loop, and the pull at which its upper layer slips.

    The shape consists of the height of the loop and the distance of its nose from the landing.

    Lengths are over L_gb, and the pull is over rho g L_gb. The landing at rest gives the length of
    the tail. The weight of the tail and the force at the landing are the load on friction.
    """

    name = "heavy-fold"
    x_name = "mu"
    y_name = "length/L_gb, pull/(rho g L_gb)"
    points = "friction"
    parameters: ClassVar = {"what": "what"}
    what: ClassVar = range(3)
    thickness = GAP * BENDING_LENGTH
    constants: ClassVar = {
        "what": "0 height, 1 nose to landing, 2 pull at slip",
        "gap_over_bending_length": GAP,
        "stretching_over_weight": STRETCHING,
        "force_scale_over_node_weight": FORCE_SHARE,
        "last_time_step_at_most": LONGEST,
        "drift_seconds": HOLD_TIME,
        "drift_share_of_slip_pull": HOLD_SHARE,
    }

    friction: Sequence[float] = FRICTION
    """Coefficients of friction of the strip with itself and with the floor.

    The shape does not depend on them.
    """
    cells: int = 120
    """Number of cells along the strip, whose length is 11.7 L_gb."""
    tolerance: float = 0.005

    folds: dict[float, tuple[tuple[float, float], ...]] = field(
        default_factory=dict, init=False, repr=False
    )

    def measure(self, mu: float, at: Mapping[str, Any]) -> tuple[float, float]:
        # One simulation gives the points of all three curves.
        if mu not in self.folds:
            self.folds[mu] = self.fold(mu)
        return self.folds[mu][at["what"]]

    def fold(self, mu: float) -> tuple[tuple[float, float], ...]:
        """Return (measured, master) of height, of nose to landing, and of pull at slip."""
        exact = master_curves.heavy_fold(GAP)
        fold = Fold(mu, self.solver, self.cells)
        height, nose_to_landing = fold.settle()
        self.tally.note(fold.drift())
        pull = fold.slip_pull()
        self.tally.count(fold.cloth)
        return (
            (height, exact.height),
            (nose_to_landing, exact.nose_to_landing),
            (pull, fold.expected),
        )

    def reported(self) -> dict[str, Setting]:
        return {**super().reported(), "cells": self.cells, "drift_mm": 1e3 * self.tally.largest}


class Fold:
    """A strip on a floor, with its upper part folded back over the lower one.

    `mu` is the friction of the strip with itself and with the floor.
    """

    def __init__(self, mu: float, preset: SolverSettings, cells: int) -> None:
        self.mu = mu
        self.preset = preset
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
        self.end = np.flatnonzero(self.along > length - 0.1 * cell)
        self.unit = weight * 2.0 * np.sqrt(0.75) * cell  # N: rho g L_gb times the width
        # The ends of the mesh are notched. A strip of the same weight with straight ends would end
        # here.
        self.straight_end = length - 0.25 * cell
        self.expected = self.tail = np.nan
        """Pull at which the upper layer slips by the master curve, and length of its tail.

        Both are NaN until the strip has come to rest.
        """
        self.landing_from = (LOWER + 0.7 * loop) * BENDING_LENGTH
        self.floor = [plane(mu)]
        self.step = FIRST_SHARE * preset.time_step
        # The strip begins as a straight part, a half circle and a straight part back.
        radius = 0.45 * BENDING_LENGTH
        bend = LOWER * BENDING_LENGTH + 0.5 * (loop * BENDING_LENGTH - np.pi * radius)
        angle = np.clip((self.along - bend) / radius, 0.0, np.pi)
        beyond = np.maximum(self.along - bend - np.pi * radius, 0.0)
        x = np.minimum(self.along, bend) + radius * np.sin(angle) - beyond
        self.cloth.set_state(np.column_stack([x, mesh.rest[:, 0], radius * (1.0 - np.cos(angle))]))

    def settle(self) -> tuple[float, float]:
        """Return the height, and the distance between nose and landing, over L_gb.

        Both are NaN if the strip does not come to rest.
        """
        if not self.rests():
            return np.nan, np.nan
        height, nose_to_landing, self.tail = self.measure()
        self.expected = float(master_curves.heavy_fold(GAP).pull(self.mu, self.tail))
        return height, nose_to_landing

    def rests(self) -> bool:
        """Step until nothing moves, and return False if the strip does not come to rest."""
        for _ in range(STEPS_MAX):
            before = self.cloth.positions
            self.cloth.step(self.step, bodies=self.floor, damping=DAMPING)
            moved = np.abs(self.cloth.positions - before).max()
            # Rest counts only in a long step: in a short one, a slow strip hardly moves either.
            if self.step == LONGEST and moved < REST:
                return True
            self.step = min(GROWTH * self.step, LONGEST)
        return False

    def pulled(self, share: float) -> None:
        """Pull at the end of the upper layer by a share of the pull of the master curve."""
        self.cloth.gravity[self.end, 0] = (
            -share * self.expected * self.unit / self.cloth.masses[self.end].sum()
        )

    def drift(self) -> float:
        """Return the largest displacement in `HOLD_TIME` without damping [m].

        The pull is the fraction `HOLD_SHARE` of the pull at slip.
        """
        if np.isnan(self.expected):
            return np.inf
        growing = round(GROWING / self.preset.time_step)
        for step in range(1, growing + 1):
            self.pulled(HOLD_SHARE * step / growing)
            self.cloth.step(self.preset.time_step, bodies=self.floor, damping=DAMPING)
        if not self.rests():
            return np.inf
        before = self.cloth.positions
        for _ in range(round(HOLD_TIME / LONGEST)):
            self.cloth.step(LONGEST, bodies=self.floor)
        return float(np.abs(self.cloth.positions - before).max())

    def slip_pull(self) -> float:
        """Return the pull over rho g L_gb at which all of the upper layer slips, or NaN.

        Call `drift` first, whose pull is the start of this one.
        """
        if np.isnan(self.expected):
            return np.nan
        dt = self.preset.time_step
        growing = round(GROWING / dt)
        for step in range(1, growing + 1):
            self.pulled(HOLD_SHARE + (FROM - HOLD_SHARE) * step / growing)
            self.cloth.step(dt, bodies=self.floor, damping=DAMPING)
        # Only the tail rubs on the layer below, so only its vertices must move.
        start = self.cloth.positions
        upper = self.along > self.straight_end - self.tail * BENDING_LENGTH
        for step in range(1, round((UP_TO - FROM) / (RATE * dt)) + 1):
            share = FROM + RATE * step * dt
            self.pulled(share)
            self.cloth.step(dt, bodies=self.floor)
            if np.abs(self.cloth.positions - start).max(axis=1)[upper].min() > MOVED:
                return float(share * self.expected)
        return np.nan

    def measure(self) -> tuple[float, float, float]:
        """Return height, nose to landing, and length beyond the landing, over L_gb.

        Beyond the landing the layer below bears the weight of each vertex. At the landing it bears
        a force besides. The landing is the centre of the surplus over the weights, because the
        layer bears no moment.
        """
        at = self.cloth.positions
        line = at[self.middle][np.argsort(self.along[self.middle])]
        height = peak(line[:, 2])
        nose = peak(line[:, 0])
        # Upward force of the layer below on each vertex.
        pairs = self.cloth.pair_forces
        lift = np.zeros(len(at))
        np.add.at(lift, pairs.vertices, pairs.weights * pairs.forces[:, None, 2])
        lies = (self.along > self.landing_from) & (lift > 0.0)
        surplus = lift[lies] - self.cloth.masses[lies] * GRAVITY
        landing = surplus @ at[lies, 0] / surplus.sum()
        # `np.interp` needs ascending positions, and the upper layer runs backwards.
        inwards = np.argsort(at[lies, 0])
        landed = np.interp(landing, at[lies, 0][inwards], self.along[lies][inwards])
        lengths = (height, nose - landing, self.straight_end - landed)
        return tuple(float(length) / BENDING_LENGTH for length in lengths)  # type: ignore[return-value]


def strip_of(cell: float, cells: int) -> meshes.Mesh:
    """Return a strip of equilateral triangles from y = 0 on, two rows wide.

    Such triangles leave the most room for a thickness.
    """
    rise = np.sqrt(0.75) * cell
    side = cell * np.arange(cells + 1)
    inner = cell * (np.arange(cells) + 0.5)
    rest = [
        np.column_stack([np.full(len(y), x), y])
        for x, y in ((-rise, side), (0.0, inner), (rise, side))
    ]
    left = np.arange(cells + 1)
    middle = cells + 1 + np.arange(cells)
    right = left + 2 * cells + 1
    triangles = [
        np.column_stack([left[:-1], middle, left[1:]]),
        np.column_stack([left[1:-1], middle[:-1], middle[1:]]),
        np.column_stack([right[:-1], right[1:], middle]),
        np.column_stack([right[1:-1], middle[1:], middle[:-1]]),
    ]
    return meshes.Mesh(np.concatenate(rest), np.concatenate(triangles).astype(np.int32))


def peak(values: np.ndarray) -> float:
    """Return the maximum of the parabola through the largest value and its two neighbours."""
    i = int(np.argmax(values))
    before, top, after = values[i - 1 : i + 2]
    return float(top + (after - before) ** 2 / (8.0 * (2.0 * top - before - after)))
