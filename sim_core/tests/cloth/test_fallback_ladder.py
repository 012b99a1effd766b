"""How often each rung of the fallback ladder was tried and converged, as a step reports it."""

import numpy as np
from stickslip_testing.tumbles import STEP, Tumble, crumple

from stickslip_sim_core import Cloth, fabric, plane, preset_named
from stickslip_sim_core.cloth import meshes

CERTIFIED = preset_named("certified")


def run(tumble: Tumble, steps: int) -> Cloth:
    for step in range(1, steps + 1):
        tumble.cloth.step(STEP, held=tumble.held(step * STEP), bodies=tumble.bodies)
    return tumble.cloth


def test_a_crumple_climbs_the_ladder() -> None:
    """Every part of a step ends at the rung that converged, and each rung is tried after the ones
    below it have failed.
    """
    total = run(crumple(1, CERTIFIED), 14).total
    rungs = total.rungs
    assert total.unconverged == 0
    assert rungs["attempt"] == (0, 0)  # only the controller attempts whole steps
    assert rungs["best_iterate"] == (0, 0)
    solved = sum(converged for _, converged in rungs.values())
    assert solved >= total.steps == 14
    plain_failed = rungs["plain"][0] - rungs["plain"][1]
    assert 0 < rungs["smoothed_law"][1] <= rungs["smoothed_law"][0] <= plain_failed


def test_steps_of_the_controller_are_attempts() -> None:
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    cloth = Cloth(mesh, fabric("gray-interlock"), CERTIFIED)
    cloth.set_state(np.column_stack([mesh.rest, np.full(len(mesh.rest), 1e-3)]))
    cloth.advance(0.2, lambda _: (cloth.gravity, np.empty((0, 3)), [plane(0.5)]))
    tried, converged = cloth.total.rungs["attempt"]
    assert tried >= converged == cloth.total.steps > 0
    assert cloth.total.rungs["plain"] == (0, 0)
