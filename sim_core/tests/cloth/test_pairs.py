"""Pairs of closest points from iterate to iterate: forces that pass on, slips, and which pairs
bear.

The lowest corner of an upright sheet, which is held, presses on a corner of a level sheet, which is
free and lies below it. All other vertices are held. Most tests let a step end after one iteration:
the forces then show what the solver assumes before it iterates.
"""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from stickslip_sim_core import Cloth, SelfContact, SolverSettings, isotropic, preset_named
from stickslip_sim_core.cloth import meshes

Floats = NDArray[np.float64]

CERTIFIED = preset_named("certified")
ONE_ITERATION = replace(
    CERTIFIED, name="one-iteration", newton_max=1, newton_before_halving=1, halvings_max=0
)
H = 1e-3
"""Thickness [m]."""

SHEET = meshes.grid(0.02, 0.02, 2, 2)
MESH = meshes.together(SHEET, SHEET)
CORNER = int(np.argmin(SHEET.rest.sum(axis=1)))
HELD = np.delete(np.arange(len(MESH.rest)), CORNER)
FROM_CORNER = SHEET.rest - SHEET.rest[CORNER]
INWARD, ACROSS, UP = np.array(
    [[0.5**0.5, 0.5**0.5, 0.0], [0.5**0.5, -(0.5**0.5), 0.0], [0.0, 0.0, 1.0]]
)
LEVEL = FROM_CORNER @ np.eye(3)[:2]
UPRIGHT = FROM_CORNER @ np.stack([ACROSS + UP, UP - ACROSS]) / np.sqrt(2.0)


def places(inward: float, height: float) -> Floats:
    """Return the vertices of both sheets [m], the upper corner this far from the lower one
    [thicknesses].
    """
    return np.concatenate([LEVEL, UPRIGHT + H * (inward * INWARD + height * UP)])


def corners(
    inward: float, height: float, mu: float = 0.0, preset: SolverSettings = ONE_ITERATION
) -> Cloth:
    cloth = Cloth(
        MESH,
        isotropic(0.2, 100.0, 1e-6),
        preset,
        held=HELD,
        self_contact=SelfContact(mu, H),
    )
    cloth.gravity[:] = 0.0
    cloth.set_state(places(inward, height))
    return cloth


def force_after(cloth: Cloth, inward: float, height: float) -> Floats:
    """Move the upper corner in a step; return the force of pairs on the free corner (3,) [N]."""
    cloth.step(0.02, held=places(inward, height)[HELD], damping=5.0)
    pairs = cloth.pair_forces
    force: Floats = (pairs.weights * (pairs.vertices == CORNER)).sum(axis=1) @ pairs.forces
    return force


def pressed(sunk: float) -> tuple[Cloth, Floats]:
    """Press the free corner down by this share of the thickness, near it and inward, in ten steps.

    Returns:
        The cloth, and the forces of pairs on the free corner in the last five steps (5, 3) [N].
    """
    cloth = corners(0.1, 1.01)
    return cloth, np.array([force_after(cloth, 0.1, 1.0 - sunk) for _ in range(10)][5:])


def test_force_turns_with_a_pair_that_begins_at_the_other_sheet() -> None:
    """The upper corner moves outward beyond the lower one.

    The pair of both corners begins at the lower one: its normal and its force point the other way.
    """
    cloth, forces = pressed(0.01)
    assert (forces[:, 2] < -1e-7).all()
    assert (cloth.pair_forces.vertices[:, 0] == len(SHEET.rest) + CORNER).all()
    after = force_after(cloth, -0.1, np.sqrt(0.99**2 - 0.1**2))
    assert (cloth.pair_forces.vertices[:, 0] == CORNER).all()
    assert after == pytest.approx(forces[-1], abs=0.2 * np.abs(forces[-1]).max())


def test_approach_along_the_normal_is_no_slip() -> None:
    """A pair closes by a tenth of the thickness and goes on by as much, with friction."""
    cloth = corners(0.1, 1.1, 0.5, CERTIFIED)
    force = force_after(cloth, 0.1, 0.9)
    assert cloth.total.newton < 20
    assert cloth.pair_forces.distance == pytest.approx(H, abs=1e-8)
    assert 0.0 < np.linalg.norm(force[:2]) < -0.51 * force[2]


def test_pair_bears_on_where_a_step_opens_it_a_little() -> None:
    """By 0.5 % of the thickness: the free corner follows, since it was pressed down further."""
    cloth, forces = pressed(0.025)
    assert (forces[:, 2] < -5e-7).all()
    after = force_after(cloth, 0.1, 0.98)
    assert 0.1 * forces[-1, 2] > after[2] > 0.9 * forces[-1, 2]


@pytest.mark.parametrize(("sinks", "bears"), [(-0.03, False), (0.01, False), (0.03, True)])
def test_pair_is_added_where_it_would_sink_in(sinks: float, bears: bool) -> None:
    """By more than 2 % of the thickness, as gravity lifts the free corner without the pair."""
    gap, little = 0.05, 1e-3 * UP
    alone = corners(0.1, 3.0)
    alone.gravity[CORNER] = little
    force_after(alone, 0.1, 3.0)
    cloth = corners(0.1, 1.0 + gap)
    cloth.gravity[CORNER] = little * (gap + sinks) * H / alone.positions[CORNER, 2]
    assert (force_after(cloth, 0.1, 1.0 + gap)[2] < -1e-7) == bears
