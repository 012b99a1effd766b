"""Friction on what is round against a cell: the stated error holds, or the run is refused.

Friction that tension causes obeys the capstan equation, whatever the cell. Friction that weight
causes, or that shear carries away, is Coulomb's.
"""

import numpy as np
import pytest

from stickslip_sim_core import Body, Cloth, cylinder, fabric, preset_named, sphere
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.protocols import edge

CERTIFIED = preset_named("certified")
REFUSED = 0.03
"""From this `friction_error` a run is refused."""


def stated_error(cloth: Cloth) -> float:
    """Return the mean error of friction by size of cells that the cloth states, over its work."""
    work, error = np.asarray(cloth.history.friction).sum(axis=(0, 1))
    return float(error / work)


LIGHT = 0.13
"""Length of the strip that hangs on the light side of a rod at first [m]."""


def pull_over_rod(mu: float, radius: float) -> edge.Pulled:
    """Pull a strip down over half a turn of a rod. Return the tensions on the heavy side."""
    mesh = meshes.grid(edge.LENGTH, edge.WIDTH, round(edge.LENGTH / edge.CELL), 2)
    along = mesh.rest[:, 0] - mesh.rest[:, 0].min() - LIGHT
    held, free = np.flatnonzero(along > along.max() - 1e-9), along < along.min() + 1e-9
    angle, high = np.clip(along / radius, 0.0, np.pi), radius + 1e-4
    beyond = along - radius * angle
    start = np.column_stack(
        [-high * np.cos(angle), mesh.rest[:, 1], high * np.sin(angle) - np.abs(beyond)]
    )
    cloth = Cloth(mesh, edge.FABRIC, CERTIFIED, held=held)
    rod: list[Body] = [cylinder(mu, radius, rotation=[[1, 0, 0], [0, 0, 1], [0, -1, 0]])]
    cloth.set_state(start, bodies=rod)

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        way = edge.SPEED * max(time - edge.START, 0.0)
        return cloth.gravity, start[held] - [0.0, 0.0, way], rod

    pulls, hanging = [], []
    for time in np.arange(edge.END - 2.0 * edge.CELL / edge.SPEED, edge.END, edge.INTERVAL):
        cloth.advance(time, motion)
        weight = -edge.LINE_WEIGHT * float(cloth.positions[held, 2].mean())
        pulls.append(weight * (1.0 - edge.DRAG) - float(cloth.reactions[held, 2].sum()))
        hanging.append(-float(cloth.positions[free, 2].mean()))
    return edge.Pulled(
        cloth, float(np.mean(pulls)), tension_needed(float(np.mean(hanging)), radius, mu)
    )


def tension_needed(hanging: float, radius: float, mu: float) -> float:
    """Return the tension [N] beyond a rod: as `edge.pull_needed`, over half a turn."""
    tension = edge.LINE_WEIGHT * hanging * (1.0 + edge.DRAG)
    for angle in (np.arange(edge.STEPS) + 0.5) / edge.STEPS * np.pi:
        weight = edge.LINE_WEIGHT * radius * (np.cos(angle) + mu * np.sin(angle) + edge.DRAG)
        tension += (mu * tension + weight) * np.pi / edge.STEPS
    return float(tension)


RESOLVED = 0.006
"""Of a pull, what the stated error misses: at 1.5 cells and more, pulls are off by up to 0.25 %. On
the kernel level baseline, the edge of 0.9 cells is 1.6 % off at mu 0.6, where 1.1 % are stated."""


def check_pull(pulled: edge.Pulled, most: float) -> None:
    """Assert that a pull, and the stated error of friction, hold; or that the run is refused.

    most: of the stated error.
    """
    assert pulled.cloth.total.unconverged == 0
    cloth = pulled.cloth
    stated = checks.values(checks.Seen(cloth, cloth.positions[None], 0))["friction_error"]
    assert stated < most
    assert abs(pulled.measured / pulled.needed - 1.0) < stated + RESOLVED


@pytest.mark.physics
@pytest.mark.parametrize("mu", [0.1, 0.6])
@pytest.mark.parametrize("cells", [0.9, 1.0, 2.0])
class TestEdges:
    def test_a_rounded_box(self, cells: float, mu: float) -> None:
        radius = cells * edge.CELL
        check_pull(edge.pull_over(edge.box_table(mu, radius), radius, mu, CERTIFIED), REFUSED)

    def test_the_skin_of_a_sharp_mesh(self, cells: float, mu: float) -> None:
        """Vertices keep half of both thicknesses, so the skin rounds the edge."""
        radius = cells * edge.CELL
        check_pull(edge.pull_over(edge.skin_table(mu, radius), radius, mu, CERTIFIED), REFUSED)

    def test_a_rod(self, cells: float, mu: float) -> None:
        check_pull(pull_over_rod(mu, cells * edge.CELL), 0.05)


CELL = 0.01  # m
TURNING = 6.0  # rad/s: friction cannot take the sheet along
DT = 0.002  # s
STEPS = 20


def turned(angle: float) -> Floats:
    """Return a turn about z [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def coefficient_under_weight(mu: float, cells: float) -> tuple[float, Cloth]:
    """Lay a sheet over a ball, and turn the ball under it about the vertical.

    Return friction over the normal forces where the sheet slides, weighted with the distance from
    the axis, after a tenth of the steps; and the cloth.
    """
    radius = cells * CELL
    mesh = meshes.grid(10 * CELL, 10 * CELL, 10, 10)
    cloth = Cloth(mesh, fabric("gray-interlock"), CERTIFIED)
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), radius + 1e-4)]))

    def ball(time: float) -> list[Body]:
        return [sphere(mu, radius, rotation=turned(TURNING * time))]

    for _ in range(150):
        cloth.step(0.01, bodies=ball(0.0), damping=10.0)
    rubbed = pressed = 0.0
    for step in range(STEPS):
        cloth.step(DT, bodies=ball(DT * (step + 1)))
        if step < STEPS // 10:
            continue
        on, forces = cloth.sliding, cloth.reactions[cloth.sliding]
        normals = cloth.positions[on] / np.linalg.norm(cloth.positions[on], axis=1)[:, None]
        normal_forces = (forces * normals).sum(axis=1)
        friction = np.linalg.norm(forces - normal_forces[:, None] * normals, axis=1)
        radii = np.linalg.norm(cloth.positions[on, :2], axis=1)
        rubbed += float((friction * radii).sum())
        pressed += float((normal_forces * radii).sum())
    return rubbed / pressed, cloth


@pytest.mark.physics
@pytest.mark.parametrize("mu", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("cells", [0.9, 1.5, 2.0, 4.0])
def test_a_sheet_under_which_a_ball_turns(cells: float, mu: float) -> None:
    """Its weight presses it to the ball, mostly by tension across friction."""
    measured, cloth = coefficient_under_weight(mu, cells)
    assert cloth.total.unconverged == 0
    stated = stated_error(cloth)
    assert abs(measured / mu - 1.0) < stated + 1e-3 or stated > REFUSED
