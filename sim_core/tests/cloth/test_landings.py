"""Steps of impacts: cloth that lands on its edge is compressed, and buckles within milliseconds."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stickslip_sim_core import Cloth, SolverSettings, fabric, plane, preset_named
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body
from stickslip_sim_core.cloth.solver import GRAVITY

pytestmark = pytest.mark.physics

MATERIAL = fabric("gray-interlock")
STRIP = meshes.grid(0.06, 0.12, 5, 10)
SPEED = 1.4  # of the landing [m/s]
ABOVE = 0.002  # above the floor at first [m]
UNTIL = ABOVE / SPEED + 0.01  # s


def impulses(preset: SolverSettings, lean: float) -> tuple[Floats, Floats]:
    """Drop a strip that leans from the vertical by an angle [rad].

    Return the ends of steps [s], and the impulses of the floor until then over the weight [s].
    """
    up = STRIP.rest[:, 1] - STRIP.rest[:, 1].min()
    start = np.column_stack([STRIP.rest[:, 0], np.sin(lean) * up, ABOVE + np.cos(lean) * up])
    cloth = Cloth(STRIP, MATERIAL, preset)
    cloth.set_state(start, np.tile([0.0, 0.0, -SPEED], (len(start), 1)))
    motion: tuple[Floats, ArrayLike, list[Body]] = (
        cloth.gravity.copy(),
        np.empty((0, 3)),
        [plane(0.3)],
    )
    times, velocities = [0.0], [-SPEED]
    while cloth.time < UNTIL:
        cloth.advance(np.nextafter(cloth.time, np.inf), lambda _: motion)
        times.append(cloth.time)
        velocities.append(float(cloth.masses @ cloth.velocities[:, 2] / cloth.masses.sum()))
    return np.array(times), (np.array(velocities) + SPEED) / GRAVITY + times


@pytest.mark.parametrize("preset", ["fast", "certified"])
@pytest.mark.parametrize("lean", [0.05, 0.1])
def test_an_edge_lands_with_the_impulse_of_short_steps(preset: str, lean: float) -> None:
    """Steps of 1 ms and more buckled it at once: the impulses were 8 and 30 % too low."""
    exact = np.interp(
        UNTIL, *impulses(replace(preset_named("fine"), step_error=None, time_step=1e-4), lean)
    )
    assert np.interp(UNTIL, *impulses(preset_named(preset), lean)) == pytest.approx(exact, rel=0.06)


@pytest.mark.parametrize("preset", ["fast", "certified"])
def test_what_lands_flat_takes_no_shorter_steps(preset: str) -> None:
    settings = preset_named(preset)
    times, _ = impulses(settings, 0.5 * np.pi)
    assert np.diff(times).min() >= settings.longest_step / settings.finest
