"""Cloth between two bodies that face each other is as thick as it is in self-contact."""

import numpy as np
import pytest

from stickslip_sim_core import Body, Cloth, box, fabric, preset_named, protocols
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.cloth.contact import COMPRESSION, THICKNESS
from stickslip_sim_core.cloth.solver import GRAVITY

pytestmark = pytest.mark.physics

SIDE = 0.08
CELLS = 16
FINGER = (0.02, 0.03, 0.03)
"""Of a box whose face holds the cloth [m]."""
CLOSING = 0.2
END = 1.0


def lifted(gap: float, mu: float = 0.3) -> Cloth:
    """Return upright cloth that two fingers close on and lift by 4 cm, at the end.

    The fingers are 3 mm apart at first, and `gap` [m] from 0.2 s on. Then they rise within 0.8 s.
    The cloth is released when they have closed.
    """
    mesh = meshes.grid(SIDE, SIDE, CELLS, CELLS)
    start = np.column_stack([np.zeros(len(mesh.rest)), mesh.rest])
    edge = np.flatnonzero(mesh.rest[:, 1] > 0.499 * SIDE)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset_named("fast"), held=edge)

    def fingers(time: float) -> list[Body]:
        closed = min(time / CLOSING, 1.0)
        apart = 3e-3 + (gap - 3e-3) * closed * closed * (3.0 - 2.0 * closed)
        risen = np.clip((time - CLOSING) / (END - CLOSING), 0.0, 1.0)
        height = 0.02 + 0.04 * risen * risen * (3.0 - 2.0 * risen)
        middle = 0.5 * (apart + FINGER[0])
        return [box(mu, FINGER, origin=(side * middle, 0.0, height)) for side in (-1.0, 1.0)]

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        return cloth.gravity, start[cloth.held], fingers(time)

    cloth.set_state(start, bodies=fingers(0.0))
    cloth.advance(CLOSING, motion, event=CLOSING, damping=lambda _time: 5.0)
    cloth.hold([], fingers(CLOSING))
    cloth.advance(END, motion, damping=lambda _time: 5.0)
    code, reason = checks.failed(checks.values(checks.Seen(cloth, cloth.positions[None], 0)))
    assert not code, reason
    return cloth


def test_fingers_lift_what_they_press() -> None:
    cloth = lifted(0.9 * THICKNESS)
    # The middle of the cloth started at a height of 0.
    assert cloth.positions[:, 2].mean() == pytest.approx(0.04, abs=5e-3)
    weight = cloth.masses.sum() * GRAVITY
    assert cloth.contact_force()[2] == pytest.approx(weight, rel=0.05)


def test_fingers_further_apart_than_the_cloth_is_thick_let_it_fall() -> None:
    cloth = lifted(1.1 * THICKNESS)
    assert cloth.positions[:, 2].mean() < -0.5


def test_each_finger_presses_and_bears_half() -> None:
    """The pressure is COMPRESSION (1 - d/h), and what both do together is known anyway."""
    closed = 0.1
    cloth = lifted((1.0 - closed) * THICKNESS)
    across = cloth.opposite_forces
    pressed = cloth.opposites >= 0
    assert (cloth.contacts[pressed] != cloth.opposites[pressed]).all()
    area = cloth.masses[pressed] / cloth.fabrics[0].density
    # The edges of the fingers are rounded, so they press less there.
    assert np.abs(across[pressed, 0]) == pytest.approx(COMPRESSION * closed * area, rel=0.02)
    assert not across[~pressed].any()
    share = across[pressed, 2].sum() / cloth.reactions[pressed, 2].sum()
    assert share == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize("preset", ["certified", "fast"])
def test_the_friction_that_a_grip_needs(preset: str) -> None:
    result = protocols.run("gripper", preset)
    assert result.passed, result.error
    assert result.error < 5e-3
