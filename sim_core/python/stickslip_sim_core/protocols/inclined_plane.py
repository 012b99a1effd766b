"""Inclined plane: the slope at which cloth begins to slide, and its creep below this slope.

The cloth is a patch on the plane, or the upper sheets of a stack.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body, SelfContact, plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.protocol import MeshedProtocol, MeshKind, rectangle
from stickslip_sim_core.protocols.result import Setting

FRICTION = (0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5)
SIDE = 0.1  # m
FABRIC = "gray-interlock"
DIRECTION = np.array([np.cos(0.5), np.sin(0.5)])  # down the slope, along no edge

HOLD_SHARE = 0.9  # of the slip angle
HOLD_TIME = 10.0  # s
DRIFT_MAX = 1e-5  # m


class OnSlope:
    """Cloth at rest on a slope.

    As the slope grows, only the cloth above an interface of friction mu should slip.

    Args:
        cloth: Cloth without a state.
        start: Positions of its vertices: (V, 3) [m].
        mu: Friction of the interface.
        floor: The plane, or its friction.
        upper: Whether each vertex is above the interface: (V,).
    """

    share_from: ClassVar[float] = 0.95
    share_to: ClassVar[float] = 1.05
    """First and last value of tan(alpha) over mu."""

    rate: ClassVar[float] = 0.01
    """Growth of tan(alpha) over mu [1/s]."""

    slid: ClassVar[float] = 1e-9
    """Cloth slides if all of its vertices have moved this far [m]."""

    def __init__(
        self, cloth: Cloth, start: Floats, mu: float, floor: float | Body, upper: NDArray[np.bool_]
    ) -> None:
        self.cloth = cloth
        self.start = start
        self.mu = mu
        self.upper = upper
        self.floor = [floor if isinstance(floor, Body) else plane(floor)]
        cloth.set_state(start)

    def moved(self) -> Floats:
        """Return the displacement of each vertex (V,) [m]."""
        return np.asarray(np.abs(self.cloth.positions - self.start).max(axis=1))

    def drift(self) -> float:
        """Return the largest displacement in `HOLD_TIME` at `HOLD_SHARE` of the slip angle [m]."""
        dt = self.cloth.preset.time_step
        self.cloth.gravity[:] = tilted(HOLD_SHARE * np.arctan(self.mu))
        for _ in range(round(HOLD_TIME / dt)):
            self.cloth.step(dt, bodies=self.floor)
        return float(self.moved().max())

    def slip_slope(self) -> float:
        """Return tan(alpha) of the slope at which all cloth above the interface slides, or NaN.

        It is NaN, too, if cloth below the interface has moved.
        """
        dt = self.cloth.preset.time_step
        for step in range(1, round((self.share_to - self.share_from) / (self.rate * dt)) + 1):
            slope = self.mu * (self.share_from + self.rate * step * dt)
            self.cloth.gravity[:] = tilted(np.arctan(slope))
            self.cloth.step(dt, bodies=self.floor)
            moved = self.moved()
            # The cloth slides as a whole only when its last vertex does.
            if moved[self.upper].min() > self.slid:
                return float(slope) if moved[~self.upper].max(initial=0.0) <= DRIFT_MAX else np.nan
        return np.nan


def tilted(angle: float) -> Floats:
    """Return gravity [m/s^2] in axes whose third is normal to a plane of this slope [rad]."""
    # Tilting gravity is the same as tilting the plane, and keeps the mesh in the plane z = 0.
    return GRAVITY * np.append(np.sin(angle) * DIRECTION, -np.cos(angle))


@dataclass(kw_only=True, eq=False)
class SlopeProtocol(MeshedProtocol):
    """Tan(alpha) of the slope at which cloth slips, against mu.

    Cloth that moves further than `DRIFT_MAX` in 10 s, at 90 % of the angle atan(mu), creeps. Its
    measurement is NaN.
    """

    x_name = "mu"
    y_name = "tan(alpha) at slip"
    points = "friction"
    constants: ClassVar = {"drift_seconds": HOLD_TIME, "drift_share_of_slip_angle": HOLD_SHARE}

    force_share: ClassVar[float]
    """Share of a node's weight that is the unit of residuals."""

    friction: Sequence[float]
    """Coefficients of friction mu."""

    @abstractmethod
    def lay(self, mu: float, at: Mapping[str, Any]) -> OnSlope:
        """Return cloth at rest on a slope."""

    def measure(self, mu: float, at: Mapping[str, Any]) -> tuple[float, float]:
        # Two simulations, since a cloth that has crept for 10 s is no clean start for the slip.
        creeping = self.lay(mu, at)
        slipping = self.lay(mu, at)
        moved = creeping.drift()
        slope = slipping.slip_slope()
        self.tally.note(moved)
        self.tally.count(creeping.cloth)
        self.tally.count(slipping.cloth)
        return slope if moved <= DRIFT_MAX else np.nan, mu

    def reported(self) -> dict[str, Setting]:
        limits = {
            "force_scale_over_node_weight": self.force_share,
            "drift_mm": 1e3 * self.tally.largest,
        }
        return super().reported() | limits


@dataclass(kw_only=True, eq=False)
class InclinedPlane(SlopeProtocol):
    """A patch on a plane.

    A resting node may bear a force beyond friction, up to the preset's tolerance times the unit of
    residuals. It slides late by as much over mu.
    """

    name = "inclined-plane"
    grids_max = 1
    force_share = 1.0

    friction: Sequence[float] = FRICTION
    cells: int = 10
    tolerance: float = 0.005

    def lay(self, mu: float, at: Mapping[str, Any]) -> OnSlope:
        mesh = rectangle(
            SIDE, SIDE, (self.cells, self.cells), SIDE / self.cells, self.kinds[at["mesh"]], 0
        )
        return patch(mesh, mu, self.solver)


def patch(mesh: meshes.Mesh, mu: float, preset: SolverSettings) -> OnSlope:
    """Return a patch of cloth on a plane of friction mu."""
    laid = fabric(FABRIC)
    weight = laid.density * mesh.spacing**2 * GRAVITY
    cloth = Cloth(mesh, laid, preset, force_scale=InclinedPlane.force_share * weight)
    start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    return OnSlope(cloth, start, mu, mu, np.ones(len(start), dtype=bool))


STACK_FRICTION = (0.1, 0.3, 0.8, 1.5)
SHEETS = (2, 4)
TOP = 0.1  # side of the sheet on top [m]
WIDER = 0.01  # extra width of each sheet below, on each side [m]
THICKNESS = 5e-4  # m
ROUGHER = 1.5  # friction of all other interfaces, over the least


@dataclass(kw_only=True, eq=False)
class StackedIncline(SlopeProtocol):
    """The upper sheets of a stack, which slide over the middle interface.

    The other interfaces are rougher than mu. A stack in which another interface slides has no slip
    angle either.
    """

    name = "stacked-incline"
    force_share = 0.1
    thickness = THICKNESS
    parameters: ClassVar = {"sheets": "sheets", "mesh": "meshes"}

    friction: Sequence[float] = STACK_FRICTION
    sheets: Sequence[int] = SHEETS
    """Numbers of sheets, at least 2 each."""
    cells: int = 4
    """Number of cells along a side of the sheet on top.

    The other sheets have cells of about the same size.
    """
    tolerance: float = 0.002

    def lay(self, mu: float, at: Mapping[str, Any]) -> "Stack":
        return Stack(at["sheets"], mu, self.solver, self.cells, self.kinds[at["mesh"]])


class Stack(OnSlope):
    """Sheets on each other on a slope, the widest at the bottom.

    The least friction, mu, is below sheet `sheets // 2`.

    The sheet on top has `cells` cells along a side.
    """

    share_from = 0.99
    share_to = 1.01
    rate = 0.002
    slid = 1e-6

    def __init__(
        self,
        sheets: int,
        mu: float,
        preset: SolverSettings,
        cells: int,
        kind: MeshKind = "alternating",
    ) -> None:
        if sheets < 2:
            raise ValueError(f"sheets: must be at least 2, got {sheets}")
        loose = sheets // 2
        # The sheet on top is the smallest, so no sheet hangs over the edge of the sheet below.
        parts = []
        for level in range(sheets):
            side = TOP + 2.0 * WIDER * (sheets - 1 - level)
            count = round(side / TOP * cells)
            parts.append(rectangle(side, side, (count, count), TOP / cells, kind, level))
        friction = np.full((sheets, sheets), ROUGHER * mu)
        friction[loose - 1, loose] = friction[loose, loose - 1] = mu
        laid = fabric(FABRIC)
        weight = laid.density * parts[-1].spacing ** 2 * GRAVITY
        cloth = Cloth(
            meshes.together(*parts),
            laid,
            preset,
            self_contact=SelfContact(friction, THICKNESS),
            force_scale=StackedIncline.force_share * weight,
        )
        start = np.concatenate(
            [
                np.column_stack([p.rest, np.full(len(p.rest), level * THICKNESS)])
                for level, p in enumerate(parts)
            ]
        )
        self.level = np.repeat(np.arange(sheets), [len(p.rest) for p in parts])
        super().__init__(cloth, start, mu, ROUGHER * mu, self.level >= loose)
