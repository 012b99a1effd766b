"""The bound on the error of friction: small where cloth slides, and large where cells catch."""

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stickslip_sim_core import Body, Cloth, SelfContact, Surface, box, custom_fabric, preset_named
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.cloth.contact import cylinder, plane
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.scenes.motions import rotation

CELL = 0.005
LENGTH, WIDTH, THICKNESS = 0.12, 0.01, 5e-4
FABRIC = custom_fabric(
    "soft", 0.2, young=4e7, poisson=0.3, thickness=5e-4, bending=[1e-7, 1e-7, 5e-8], damping=2.0
)
LIMIT = next(check.limit or 0.0 for check in checks.CHECKS if check.name == "friction_error")

BLOCK = [
    *[(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
    *[(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
]
"""Triangles of a block, whose corners are in the order of x, then y, then z."""


def block(cells: float, mu: float) -> Surface:
    """A block of triangles, whose skin rounds its edges with a radius in cells."""
    corners = np.array([(x, y, z) for x in (-0.2, 0.0) for y in (-0.05, 0.05) for z in (-0.1, 0.0)])
    return Surface(BLOCK, corners, mu, 2.0 * cells * CELL - THICKNESS)


def strip(
    *, bodies: list[Body], surfaces: tuple[Surface, ...] = (), height: float, seconds: float = 1.5
) -> checks.Seen:
    """A strip hangs over an edge at x = 0, and is pulled back over it by 2 cm/s."""
    mesh = meshes.grid(LENGTH, WIDTH, round(LENGTH / CELL), 2)
    held = np.flatnonzero(mesh.rest[:, 0] < -0.5 * LENGTH + 1e-9)
    contact = SelfContact(0.5, THICKNESS) if surfaces else None
    cloth = Cloth(
        mesh,
        FABRIC,
        preset_named("certified"),
        held=held,
        self_contact=contact,
        surfaces=surfaces,
    )
    flat = np.full(len(mesh.rest), height)
    start = np.column_stack([mesh.rest[:, 0], mesh.rest[:, 1], flat])
    cloth.set_state(start, bodies=bodies)

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        way = 0.02 * max(time - 0.5, 0.0)
        return cloth.gravity, start[held] - [way, 0.0, 0.0], bodies

    cloth.advance(seconds, motion)
    names = [f"bodies.body {n}" for n in range(len(bodies))] + ["bodies.block"] * len(surfaces)
    return checks.Seen(cloth, cloth.positions[None], 0, None, [*names, "sheets.cloth"])


def friction_error(state: checks.Seen) -> float:
    return checks.values(state)["friction_error"]


@pytest.mark.physics
class TestEdges:
    @pytest.mark.parametrize("mu", [0.1, 0.5])
    @pytest.mark.parametrize("cells", [1.0, 2.0])
    def test_a_round_box_passes(self, cells: float, mu: float) -> None:
        table = box(mu, (0.4, 0.1, 0.2), rounding=cells * CELL, origin=(-0.2, 0.0, -0.1))
        state = strip(bodies=[table], height=2e-4)
        assert 0.0 < friction_error(state) < 0.5 * LIMIT

    def test_the_skin_of_a_mesh_of_a_cell_passes(self) -> None:
        state = strip(bodies=[], surfaces=(block(1.0, 0.4),), height=CELL + 2e-4)
        assert 0.0 < friction_error(state) < 0.5 * LIMIT

    def test_a_sharp_mesh_fails_and_the_reason_says_what_to_change(self) -> None:
        """On a crease of a quarter of a cell, friction of mu 0.2 is 19 % off."""
        state = strip(bodies=[], surfaces=(block(0.25, 0.2),), height=0.25 * CELL + 2e-4)
        assert friction_error(state) > 1.5 * LIMIT
        code, reason = checks.failed(checks.values(state), state)
        assert code == "friction_error"
        finer = math.sqrt(friction_error(state) / LIMIT)
        assert reason.endswith(
            "bodies.block is too sharp for the cells of the cloth: give it edges with a radius of "
            "5 mm, or a mesh a thickness of 10 mm; if it is round already, make its radius larger, "
            f"or the cells smaller, by a factor of {math.ceil(20.0 * finer) / 20.0:.3g}"
        )

    def test_a_calm_body_does_not_hide_a_sharp_one(self) -> None:
        """Friction is judged for each body: work on a floor adds nothing to that on a block."""
        floor = plane(0.5, origin=(0.0, 0.0, -0.03))
        alone = strip(bodies=[], surfaces=(block(0.25, 0.2),), height=0.25 * CELL + 2e-4)
        both = strip(bodies=[floor], surfaces=(block(0.25, 0.2),), height=0.25 * CELL + 2e-4)
        assert friction_error(alone) > LIMIT
        assert friction_error(both) > LIMIT


def slid(bodies: list[Body], surfaces: tuple[Surface, ...], push: ArrayLike) -> Cloth:
    """A sheet slides for 0.5 s on what is below it, under gravity and a push [m/s^2]."""
    mesh = meshes.grid(0.03, 0.03, 6, 6)
    contact = SelfContact(0.5, THICKNESS) if surfaces else None
    cloth = Cloth(mesh, FABRIC, preset_named("certified"), self_contact=contact, surfaces=surfaces)
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), 6e-4 if surfaces else 0.0)])
    cloth.set_state(start, bodies=bodies)
    gravity = np.array([0.0, 0.0, -GRAVITY]) + push + np.zeros_like(start)
    cloth.advance(0.5, lambda _: (gravity, np.empty((0, 3)), bodies))
    return cloth


@pytest.mark.physics
def test_flat_faces_have_no_error() -> None:
    """Of a floor, and of a turning mesh: what turns is the mesh, and not the contact."""
    floor = slid([plane(0.2)], (), [4.0, 0.0, 0.0])
    assert checks.values(checks.Seen(floor, floor.positions[None], 0))["friction_error"] < 1e-12
    assert floor.history.friction[:, 0, 0].sum() > 0.0
    corners = np.array([(-0.2, -0.2, 0.0), (0.2, -0.2, 0.0), (0.2, 0.2, 0.0), (-0.2, 0.2, 0.0)])

    def tilting(time: float) -> Floats:
        return np.asarray(corners @ rotation([0.0, 0.4 * time, 0.0]).T)

    turning = slid([], (Surface([(0, 1, 2), (0, 2, 3)], tilting, 0.1),), [4.0, 0.0, 0.0])
    assert turning.history.friction[:, 0, 0].sum() > 0.0
    # Corners of the sheet dip over the mesh as it tilts, by 0.009 to 0.014, as rounding has it.
    error = checks.values(checks.Seen(turning, turning.positions[None], 0))["friction_error"]
    assert error < 0.75 * LIMIT


@pytest.mark.physics
def test_the_correction_counts_where_weight_presses() -> None:
    """On a rod: e = a^4/75 with sin(a/2) = h/(2 R), of all that slides there, and the correction,
    (1 + mu^2) a^2/12, as a sheet that lies there without tension needs none.
    """
    mu = 0.1
    for radius in (0.03, 0.015):
        rod = cylinder(mu, radius, origin=(0.0, 0.0, -radius), rotation=rotation([np.pi / 2, 0, 0]))
        cloth = slid([rod], (), [4.0, 0.0, 0.0])
        work, error = cloth.history.friction[:, 0].sum(axis=0)
        turn = 2.0 * np.arcsin(CELL / (2.0 * radius))
        most = turn**4 / 75.0 + (1.0 + mu**2) * turn**2 / 12.0
        # Bending presses, too.
        assert 0.5 * most < error / work < 1.01 * most


@pytest.mark.physics
def test_a_ply_that_is_peeled_off_another_has_no_error() -> None:
    """Both are flat where they touch: what turns is the ply, and not the contact as it slides.

    Without regard to that, the bound was 0.05 in such a scene.
    """
    ply = meshes.grid(0.1, 0.1, 8, 8)
    cloth = Cloth(
        meshes.together(ply, ply),
        FABRIC,
        preset_named("fast"),
        held=len(ply.rest) + np.flatnonzero(ply.rest[:, 0] > 0.05 - 1e-9),
        self_contact=SelfContact([[0.5, 0.4], [0.4, 0.5]], THICKNESS),
    )
    heights = np.repeat([0.0, 2.0 * THICKNESS], len(ply.rest))
    start = np.column_stack([np.tile(ply.rest, (2, 1)), heights])
    table = [plane(0.5)]
    cloth.set_state(start, bodies=table)

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        lift = 0.02 * min(time / 0.4, 1.0)
        way = 0.05 * max(time - 0.4, 0.0)
        return cloth.gravity, start[cloth.held] + [way, 0.0, lift], table

    cloth.advance(1.4, motion)
    assert cloth.history.friction[:, -2:, 0].sum() > 0.0
    state = checks.Seen(cloth, cloth.positions[None], 0)
    assert friction_error(state) < 0.1 * LIMIT
