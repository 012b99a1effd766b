"""Friction on what is round against a cell obeys the capstan equation, whatever the cell."""

import numpy as np
import pytest

from stickslip_sim_core import Body, Cloth, SelfContact, Surface, box, custom_fabric, preset_named
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.solver import GRAVITY

CELL = 0.005
LENGTH, WIDTH = 0.2, 0.01
BEFORE = 0.08
"""Length of the strip that lies on the table at first [m]."""

FABRIC = custom_fabric(
    "soft",
    0.2,
    young=4e7,
    poisson=0.3,
    thickness=5e-4,
    bending=[1e-7, 1e-7, 5e-8],
    damping=2.0,
)
THICKNESS = 5e-4

CUBE = [
    *[(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
    *[(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
]
"""Triangles of a cube, whose corners are in the order of x, then y, then z."""

LINE_WEIGHT = 0.2 * GRAVITY * WIDTH
"""Of the strip [N/m]."""

SPEED, START, END = 0.02, 1.0, 3.0
"""Of the end that is pulled [m/s], from the start on [s]."""


def pull_needed(hanging: float, flat: float, radius: float, mu: float) -> float:
    """Return the pull [N] on a strip without stiffness over a quarter turn of a radius [m].

    dT/da = mu T + q R (sin a + mu cos a) from the hanging part, of a length `hanging` [m], to the
    flat part, of a length `flat`, where friction of the weight is added.
    """
    tension, steps = LINE_WEIGHT * hanging, 2000
    for angle in (np.arange(steps) + 0.5) / steps * np.pi / 2:
        # From the side of the table, where the face is upright, to the top.
        own = LINE_WEIGHT * radius * (np.cos(angle) + mu * np.sin(angle))
        tension += (mu * tension + own) * np.pi / 2 / steps
    return tension + mu * LINE_WEIGHT * flat


def pulled_over(
    cloth: Cloth, bodies: list[Body], height: float, corner: float, radius: float, mu: float
) -> float:
    """Pull a strip over an edge, and return the mean pull over what the capstan equation asks.

    `height`: of the strip over the table at first [m]; `corner`: where the flat part ends [m].
    """
    rest = cloth.mesh.rest
    start = np.column_stack(
        [rest[:, 0] + 0.5 * LENGTH - BEFORE, rest[:, 1], rest[:, 0] * 0 + height]
    )
    cloth.set_state(start, bodies=bodies)

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        way = SPEED * max(time - START, 0.0)
        return cloth.gravity, start[cloth.held] - [way, 0.0, 0.0], bodies

    ratios = []
    # The pull goes up and down as cells pass: the mean is that over two cells of way.
    for time in np.arange(END - 2 * CELL / SPEED, END, 0.02):
        cloth.advance(time, motion)
        flat = corner - float(cloth.positions[cloth.held, 0].mean())
        hanging = LENGTH - flat - radius * np.pi / 2
        pull = -float(cloth.reactions[cloth.held, 0].sum())
        ratios.append(pull / pull_needed(hanging, flat, radius, mu))
    assert cloth.total.unconverged == 0
    return float(np.mean(ratios))


def strip(surfaces: tuple[Surface, ...] = ()) -> Cloth:
    mesh = meshes.grid(LENGTH, WIDTH, round(LENGTH / CELL), 2)
    held = np.flatnonzero(mesh.rest[:, 0] < -0.5 * LENGTH + 1e-9)
    contact = SelfContact(0.5, THICKNESS) if surfaces else None
    return Cloth(
        mesh,
        FABRIC,
        preset_named("certified"),
        held=held,
        self_contact=contact,
        surfaces=surfaces,
    )


@pytest.mark.physics
class TestEdges:
    @pytest.mark.parametrize("mu", [0.1, 0.6])
    @pytest.mark.parametrize("cells", [1.0, 2.0])
    def test_a_rounded_box(self, cells: float, mu: float) -> None:
        radius = cells * CELL
        table = box(mu, (0.4, 0.1, 0.2), rounding=radius, origin=(-0.2, 0.0, -0.1))
        ratio = pulled_over(strip(), [table], 2e-4, -radius, radius, mu)
        assert ratio == pytest.approx(1.0, abs=0.03)

    @pytest.mark.parametrize("cells", [1.0, 2.0])
    def test_the_skin_of_a_sharp_mesh(self, cells: float) -> None:
        """Vertices keep half of both thicknesses, so the skin rounds the edge."""
        mu, radius = 0.6, cells * CELL
        corners = np.array(
            [(x, y, z) for x in (-0.2, 0.0) for y in (-0.05, 0.05) for z in (-0.1, 0.0)]
        )
        table = Surface(CUBE, corners, mu, 2.0 * radius - THICKNESS)
        ratio = pulled_over(strip((table,)), [], radius + 2e-4, 0.0, radius, mu)
        assert ratio == pytest.approx(1.0, abs=0.03)
