"""Stick-Slip: the friction at which the tip of a buckled strip slips on a wall.

The sources are [Sano et al. 2017; Romero et al. 2021].

A clamped strip without weight is pressed end-on against a wall. The clamp comes down by (rate t)^2
times the length of the strip. Q/P is proportional to the square root of this strain, so it grows at
an even pace. At some strain the tip leaves its place. `master_curves.stick_slip` converts this
strain to the friction of the solver.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import isotropic
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.protocols.protocol import LENGTH, RefinedProtocol, Strip, cell_of, strip
from stickslip_sim_core.protocols.result import Setting
from stickslip_sim_core.reference import master_curves

FRICTION = (0.05, 0.1, 0.2, 0.3, 0.34)
CELLS_ACROSS = 2

DENSITY = 0.05  # kg/m^2
RIGIDITY = 1e-4  # N m
STRETCHING = 3e4  # N/m
# Growth of the root of the strain [1/s]. It is slower if the tip slips below ROOT, so that steps
# resolve such a slip as well.
RATE = 5e-3
ROOT = 0.25
# Largest growth of that root in a step. The slip is known to half a step, which is 2e-4 of the
# friction at ROOT, and the limit of small cells has up to twice this error. It may be 1e-3.
ROOT_STEP = 1e-4
# Damping [1/s]: the bounce of a buckling strip must not tear its tip off.
DAMPING = 20.0

# Share of the load that acts sideways until the strip has buckled to a side. Without it a straight
# strip stays straight.
BIAS = 2e-4
BIAS_UNTIL = 2e-3  # strain

# Unit of residuals, over a node's share of the buckling load.
FORCE_SHARE = 0.03

# Share of the length: a tip that has moved this far has slipped.
MOVED = 2e-4
# Share of the length: the slip begins after the last step that moves the tip by at most this.
LET_GO = 1e-6

# Strains of the phase diagram, and frictions beyond the triple point.
PHASE_STRAIN = tuple(round(0.02 * i, 2) for i in range(1, 23))
PHASE_FRICTION = (0.38, 0.5)
STICK = 0.0
SLIP = 1.0
EXTENDED = 2.0


@dataclass(frozen=True)
class Press:
    """The result of pressing a strip until its tip slips, or to the largest strain."""

    slip: float
    """Strain at which the tip slipped, or NaN."""

    extended: float
    """Strain at which vertices besides the tip's first touched the wall, or NaN."""

    static_error: float
    """Largest |relative error| of Q/P while the tip stuck, or NaN without such a strain.

    It covers strains above a quarter of the last one, which is the second half of the range of Q/P.
    """

    cloth: Cloth


@dataclass(kw_only=True, eq=False)
class StickSlip(RefinedProtocol):
    """The friction at which tips slip, against that of the wall.

    Raises:
        ValueError: A friction is not on the master curve.
    """

    name = "stick-slip"
    x_name = "mu"
    y_name = "mu at which the tip slips"
    points = "friction"

    friction: Sequence[float] = FRICTION
    """Coefficients of friction of the wall, between 0 and 0.356370 at the triple point."""
    phases: bool = True
    """Whether to press the finest grid beyond the triple point, too, for the phase diagram."""

    diagram: list[tuple[float, float, float]] = field(default_factory=list, init=False, repr=False)
    """(mu, strain, regime) of the first mesh."""

    def __post_init__(self) -> None:
        super().__post_init__()
        # It refuses a friction that is not on the master curve, before anything runs.
        master_curves.stick_slip_strain(self.friction)

    def measure_with(self, cells: int, x: float, at: Mapping[str, Any]) -> float:
        strain = self.press(cells, at["mesh"], x, master_curves.stick_slip_triple_point()[0]).slip
        return float(master_curves.stick_slip(strain)) if np.isfinite(strain) else np.nan

    def master(self, x: float, at: Mapping[str, Any]) -> float:
        return x

    def press(self, cells: int, mesh: int, mu: float, end: float) -> "Press":
        """Press the strip of a mesh up to the strain `end`."""
        pressed = strip(CELLS_ACROSS * cell_of(cells), cells, self.kinds[mesh])
        # Frictions beyond the triple point have no strain on the master curve.
        onset = np.sqrt(master_curves.stick_slip_strain(mu)) if mu in self.friction else ROOT
        rate = growth_rate(self.solver.time_step, float(onset))
        outcome = press(pressed, mu, self.solver, end, rate)
        if mesh == 0 and cells == self.cells[-1]:
            self.diagram += _phases(mu, outcome, end)
        if cells == self.cells[-1] and np.isfinite(outcome.static_error):
            self.tally.note(outcome.static_error)
        self.tally.count(outcome.cloth)
        return outcome

    def reported(self) -> dict[str, Setting]:
        # The measured curve ends at the triple point, and the diagram does not.
        for mu in PHASE_FRICTION if self.phases and self.kinds else ():
            self.press(self.cells[-1], 0, mu, PHASE_STRAIN[-1])
        columns = list(zip(*self.diagram, strict=True)) or [(), (), ()]
        return {
            **super().reported(),
            "static_ratio_error": self.tally.largest,
            **dict(zip(("phase_mu", "phase_strain", "phase_regime"), columns, strict=True)),
        }


def growth_rate(time_step: float, onset: float) -> float:
    """Return the growth of the root of the strain [1/s].

    Args:
        time_step: Length of a step [s].
        onset: Root of the strain at which the tip is expected to slip.
    """
    return min(RATE, ROOT_STEP / time_step) * min(1.0, onset / ROOT)


def press(
    clamped: Strip, mu: float, preset: SolverSettings, strain_end: float, rate: float
) -> Press:
    """Press a strip against a wall of friction `mu` until its tip slips, or to `strain_end`.

    The root of the strain grows by `rate` [1/s].
    """
    held = clamped.held
    tip = clamped.tip
    width = float(np.ptp(clamped.across))
    buckling = 20.1907 * RIGIDITY * width / LENGTH**2  # N
    cloth = Cloth(
        clamped.mesh,
        isotropic(DENSITY, STRETCHING, RIGIDITY),
        preset,
        held=held,
        force_scale=FORCE_SHARE * buckling / len(tip),
    )
    # The wall is the floor, and the clamp is above it.
    upright = np.stack(
        [np.zeros_like(clamped.along), clamped.across, LENGTH - clamped.along], axis=1
    )
    cloth.set_state(upright)
    wall = [plane(mu)]
    clamp = upright[held]
    mass = float(cloth.masses.sum())
    dt = preset.time_step
    history: list[tuple[float, float, float]] = []
    slip = extended = np.nan
    for step in range(1, int(np.sqrt(strain_end) / (rate * dt)) + 1):
        strain = (rate * step * dt) ** 2
        # Compression gives the load of a straight strip. A buckled one bears about the buckling
        # load.
        load = min(STRETCHING * width * strain, buckling)
        cloth.gravity[:] = [BIAS * load / mass * max(0.0, 1.0 - strain / BIAS_UNTIL), 0.0, 0.0]
        cloth.step(dt, held=clamp - [0.0, 0.0, strain * LENGTH], bodies=wall, damping=DAMPING)
        force = cloth.reactions[tip].sum(axis=0)
        moved = abs(cloth.positions[tip, 0].mean()) / LENGTH
        history.append(
            (strain, float(np.hypot(force[0], force[1]) / max(force[2], 1e-15)), float(moved))
        )
        touching = np.flatnonzero(cloth.contacts >= 0)
        if np.isnan(extended) and not np.isin(touching, tip).all():
            extended = strain
        # A position that is not a number ends the run as well.
        if not moved <= MOVED:
            break
    strain_at, ratio, moved_at = np.array(history).T
    if not moved_at[-1] <= MOVED:
        stuck = np.flatnonzero(np.abs(np.diff(moved_at, prepend=0.0)) <= LET_GO)
        last = int(stuck[-1]) if len(stuck) else 0
        # The strain in the middle of the step in which the tip began to move.
        slip = (rate * (last + 1.5) * dt) ** 2
        strain_at = strain_at[:last]
        ratio = ratio[:last]
    # Compare Q/P at some 20 strains only, since each needs a solution of the master curve.
    on_curve = (strain_at > 0.25 * strain_at[-1:].max(initial=0.0)) & (
        strain_at <= master_curves.stick_slip_triple_point()[0]
    )
    sampled = np.flatnonzero(on_curve)[:: max(1, int(on_curve.sum()) // 20)]
    static = np.abs(ratio[sampled] / master_curves.stick_slip(strain_at[sampled]) - 1.0)
    return Press(slip, extended, float(static.max()) if len(static) else np.nan, cloth)


def _phases(mu: float, outcome: Press, end: float) -> list[tuple[float, float, float]]:
    """Return (mu, strain, regime) at the strains of the phase diagram.

    A tip that has slipped once counts as slipping from then on.
    """
    points = []
    for strain in PHASE_STRAIN:
        if strain <= end or np.isfinite(outcome.slip):
            regime = (
                SLIP
                if strain >= outcome.slip
                else EXTENDED
                if strain >= outcome.extended
                else STICK
            )
            points.append((mu, strain, regime))
    return points
