"""Motion of second order in time: its order, what it leaves as it is, and what it must not do."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stickslip_sim_core import Cloth, SelfContact, SolverSettings, fabric, plane, preset_named
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.solver import GRAVITY

pytestmark = pytest.mark.physics

CERTIFIED = preset_named("certified")
FIRST_ORDER = replace(CERTIFIED, second_order=False)
MATERIAL = fabric("gray-interlock")
STRIP = meshes.grid(0.02, 0.2, 2, 20)
TOP = np.flatnonzero(STRIP.rest[:, 1] > 0.1 - 1e-9)
TIP = np.flatnonzero(STRIP.rest[:, 1] < -0.1 + 1e-9)
TILT = np.deg2rad(17.0)
TURNING = 0.4  # of gravity [s]


def gravity_at(time: float) -> Floats:
    """Gravity that is tilted at first, and turns upright without a jump."""
    tilt = TILT * 0.5 * (1.0 + np.cos(np.pi * min(time / TURNING, 1.0)))
    return np.tile(GRAVITY * np.array([np.sin(tilt), 0.0, -np.cos(tilt)]), (len(STRIP.rest), 1))


@pytest.fixture(scope="module")
def hung() -> Floats:
    """The strip at rest under tilted gravity: stretched, so that no wave runs through it."""
    down = 0.1 - STRIP.rest[:, 1]
    start = np.column_stack([np.sin(TILT) * down, STRIP.rest[:, 0], -np.cos(TILT) * down])
    settings = replace(FIRST_ORDER, step_error=None, time_step=0.01, tolerance=1e-7)
    cloth = Cloth(STRIP, MATERIAL, settings, held=TOP)
    cloth.set_state(start)
    still = gravity_at(0.0)
    cloth.advance(5.0, lambda _: (still, start[TOP], []), damping=lambda _: 10.0)
    assert np.abs(cloth.velocities).max() < 1e-9
    return cloth.positions


def swung(start: Floats, settings: SolverSettings, end: float = 1.0) -> tuple[Cloth, Floats]:
    """Return the cloth and the path of its tip, 100 frames a second: (frames, 3) [m]."""
    cloth = Cloth(STRIP, MATERIAL, settings, held=TOP)
    cloth.set_state(start)
    path = []
    for frame in range(1, round(100 * end) + 1):
        cloth.advance(frame / 100, lambda time: (gravity_at(time), start[TOP], []))
        path.append(cloth.positions_at(frame / 100)[TIP].mean(axis=0))
    return cloth, np.array(path)


def error(hung: Floats, settings: SolverSettings, step: float, reference: Floats) -> float:
    path = swung(hung, replace(settings, step_error=None, time_step=step))[1]
    return float(np.sqrt(((path - reference) ** 2).sum(axis=1).mean()))


def test_a_swing_converges_with_second_order(hung: Floats) -> None:
    exact = replace(CERTIFIED, tolerance=1e-6)
    reference = swung(hung, replace(exact, step_error=None, time_step=2.5e-4))[1]
    errors = [error(hung, exact, step, reference) for step in (0.008, 0.004, 0.002)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (orders > 1.7).all(), orders
    first = error(hung, replace(exact, second_order=False), 0.008, reference)
    assert errors[0] < 0.1 * first


def test_a_swing_gains_no_energy(hung: Floats) -> None:
    for settings in (CERTIFIED, replace(CERTIFIED, step_error=None, time_step=0.01)):
        total = swung(hung, settings, 2.0)[0].total
        assert total.seen.gain < 1e-3 * total.seen.flow


@pytest.mark.parametrize("slope", [0.0, 0.299])
def test_what_sticks_does_not_move(slope: float) -> None:
    """On the level, and on an incline just below the angle of friction: bit for bit."""
    mesh = meshes.grid(0.1, 0.1, 6, 6)
    cloth = Cloth(mesh, MATERIAL, CERTIFIED)
    start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    cloth.set_state(start)
    down = GRAVITY * np.array([slope, 0.0, -1.0]) / np.hypot(1.0, slope)
    gravity = np.tile(down, (len(start), 1))
    cloth.advance(1.0, lambda _: (gravity, np.empty((0, 3)), [plane(0.3)]))
    assert cloth.positions.tobytes() == start.tobytes()


def test_sheets_that_collide_keep_their_momentum() -> None:
    """In flight, where nothing else touches them: all of their nodes go by one scheme then."""
    mesh = meshes.grid(0.06, 0.06, 4, 4)
    cloth = Cloth(
        meshes.together(mesh, mesh), MATERIAL, CERTIFIED, self_contact=SelfContact(0.5, 5e-4)
    )
    flat = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])
    start = np.concatenate([flat, flat + np.array([0.004, 0.003, 0.01])])
    speed = np.repeat([[0.3, 0.1, 0.5], [-0.2, 0.0, -0.5]], len(flat), axis=0)
    cloth.set_state(start, speed)
    still = np.zeros((len(start), 3))
    before = cloth.masses @ speed
    nothing: tuple[Floats, ArrayLike, list[Body]] = (still, np.empty((0, 3)), [])
    cloth.advance(0.1, lambda _: nothing)
    assert cloth.masses @ cloth.velocities == pytest.approx(before, rel=1e-6)
    # They did meet.
    assert np.abs(cloth.velocities - speed).max() > 0.3
