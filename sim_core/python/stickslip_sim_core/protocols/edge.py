"""Edge: a strip with weight is pulled from an edge whose radius is that of a few cells.

The edge is that of a rounded box, or of a sharp mesh with a skin.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import THICKNESS, Body, SelfContact, Surface, box
from stickslip_sim_core.cloth.fabrics import custom_fabric
from stickslip_sim_core.cloth.presets import SolverSettings
from stickslip_sim_core.cloth.solver import GRAVITY, Cloth
from stickslip_sim_core.protocols.protocol import ClothProtocol

RADII = (1.0, 2.0, 3.0)
FRICTION = (0.3, 0.6)
BOX = 0
SKIN = 1
"""Edges: that of a rounded box, and that of a sharp mesh with a skin."""

CELL = 0.005  # m
LENGTH = 0.2
WIDTH = 0.01  # m
# Length of the strip that lies on the table at first [m].
BEFORE = 0.08
DENSITY = 0.2  # kg/m^2
FABRIC = custom_fabric(
    "soft",
    DENSITY,
    young=4e7,
    poisson=0.3,
    thickness=THICKNESS,
    bending=[1e-7, 1e-7, 5e-8],
    damping=2.0,
)
LINE_WEIGHT = DENSITY * GRAVITY * WIDTH  # N/m
SPEED = 0.02  # of the end that is pulled [m/s]
# The strip starts this far above the table [m]. Its held end comes down to it in a time [s]: one
# that stays above lifts a centimetre of the strip, which then does not rub.
ABOVE = 2e-4
LOWERED = 0.5
DRAG = FABRIC.damping * SPEED / GRAVITY
"""Of damping, over the weight."""
# The end is pulled from the first time to the last [s].
START = 1.0
END = 3.0
# The pull goes up and down as cells pass: the mean is that over two cells of way, at this interval.
INTERVAL = 0.02  # s
STEPS = 2000
"""Of the integration over a quarter turn."""

CORNERS = np.array([(x, y, z) for x in (-0.2, 0.0) for y in (-0.05, 0.05) for z in (-0.1, 0.0)])
"""Of the mesh [m]. The strip passes the edge at the origin."""

TRIANGLES = [
    *[(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
    *[(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
]


@dataclass(kw_only=True, eq=False)
class Edge(ClothProtocol):
    """The pull on a strip that slides over an edge, over its weight on a metre.

    The master curve is the capstan equation with the weight of the strip.
    """

    name = "edge"
    x_name = "radius [cells]"
    y_name = "pull over weight of a metre"
    points = "radii"
    parameters: ClassVar = {"edge": "edges", "mu": "friction"}
    constants: ClassVar = {"cell": CELL, "speed": SPEED}

    radii: Sequence[float] = RADII
    """Radii over the side of a cell."""
    friction: Sequence[float] = FRICTION
    edges: Sequence[int] = (BOX, SKIN)
    tolerance: float = 0.03

    def measure(self, x: float, at: Mapping[str, Any]) -> tuple[float, float]:
        radius = x * CELL
        mu = at["mu"]
        table = box_table(mu, radius) if at["edge"] == BOX else skin_table(mu, radius)
        pulled = pull_over(table, radius, mu, self.solver)
        self.tally.count(pulled.cloth)
        return pulled.measured / LINE_WEIGHT, pulled.needed / LINE_WEIGHT


def pull_needed(hanging: float, flat: float, radius: float, mu: float) -> float:
    """Return the pull [N] on a strip without stiffness over a quarter turn of a radius [m].

    dT/da = mu T + q R (sin a + mu cos a + d) from the hanging part, of a length `hanging` [m], to
    the flat part, of a length `flat`, where friction of the weight is added. All of the strip
    moves, and its damping adds d of its weight to the pull.
    """
    tension = LINE_WEIGHT * hanging * (1.0 + DRAG)
    for angle in (np.arange(STEPS) + 0.5) / STEPS * np.pi / 2:
        # From the side of the table, where the face is upright, to the top.
        weight = LINE_WEIGHT * radius * (np.cos(angle) + mu * np.sin(angle) + DRAG)
        tension += (mu * tension + weight) * np.pi / 2 / STEPS
    return float(tension + LINE_WEIGHT * (mu + DRAG) * flat)


@dataclass(frozen=True)
class Table:
    """The body that a strip is pulled over."""

    bodies: Sequence[Body]
    surfaces: Sequence[Surface]
    height: float
    """Of the strip that lies on the table [m]."""
    corner: float
    """Where its flat part ends [m]."""
    side: float
    """Height at which its hanging part begins [m]."""


def box_table(mu: float, radius: float) -> Table:
    """Return a box whose edges are rounded with a radius [m]."""
    body = box(mu, (0.4, 0.1, 0.2), rounding=radius, origin=(-0.2, 0.0, -0.1))
    return Table([body], (), 0.0, -radius, -radius)


def skin_table(mu: float, radius: float) -> Table:
    """Return a sharp mesh with a skin that keeps vertices at a radius [m] from it."""
    surface = Surface(TRIANGLES, CORNERS, mu, 2.0 * radius - THICKNESS)
    return Table((), [surface], radius, 0.0, 0.0)


@dataclass(frozen=True)
class Pulled:
    """A strip that was pulled over an edge, and the mean pulls [N]."""

    cloth: Cloth
    measured: float
    needed: float


def pull_over(table: Table, radius: float, mu: float, preset: SolverSettings) -> Pulled:
    """Pull a strip over the edge of a table, which has a radius [m]."""
    mesh = meshes.grid(LENGTH, WIDTH, round(LENGTH / CELL), 2)
    held = np.flatnonzero(mesh.rest[:, 0] < -0.5 * LENGTH + 1e-9)
    free = np.flatnonzero(mesh.rest[:, 0] > 0.5 * LENGTH - 1e-9)
    contact = SelfContact(0.5, THICKNESS) if table.surfaces else None
    cloth = Cloth(mesh, FABRIC, preset, held=held, self_contact=contact, surfaces=table.surfaces)
    along = mesh.rest[:, 0] + 0.5 * LENGTH - BEFORE
    start = np.column_stack([along, mesh.rest[:, 1], np.full(len(along), table.height + ABOVE)])
    cloth.set_state(start, bodies=table.bodies)

    def motion(time: float) -> tuple[Floats, Floats, Sequence[Body]]:
        way = SPEED * max(time - START, 0.0)
        down = ABOVE * min(time / LOWERED, 1.0)
        return cloth.gravity, start[held] - [way, 0.0, down], table.bodies

    pulls = []
    needs = []
    for time in np.arange(END - 2.0 * CELL / SPEED, END, INTERVAL):
        cloth.advance(time, motion)
        flat = table.corner - float(cloth.positions[held, 0].mean())
        hanging = table.side - float(cloth.positions[free, 2].mean())
        pulls.append(-float(cloth.reactions[held, 0].sum()))
        # The holder bears half of the last cell, which does not rub.
        needs.append(pull_needed(hanging, flat - 0.5 * CELL, radius, mu))
    return Pulled(cloth, float(np.mean(pulls)), float(np.mean(needs)))
