"""Evenness of motions up to the last frame, which lies within the last step."""

import numpy as np
import pytest

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body, cylinder, plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.presets import preset_named
from stickslip_sim_core.cloth.solver import Cloth
from stickslip_sim_core.rotations import matrices_of_vectors, vectors_of_matrices
from stickslip_sim_core.scenes.evenness import uneven_until
from stickslip_sim_core.scenes.motions import rotation

SPEED = 3.0
"""Speed of a rod that turns about its axis [rad/s]."""


def unevenness(stops_at: float) -> float:
    """Cloth rests on a floor beside a rod that turns; the last frame is at 0.9 s.

    The rod stops earlier, as the looks see it.
    """
    mesh = meshes.grid(0.1, 0.1, 4, 4)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset_named("certified"))
    start = np.column_stack([mesh.rest, np.zeros(len(mesh.rest))])

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        turn = rotation([0.0, 0.0, SPEED * time])
        rod = cylinder(0.5, 0.05, origin=(0.15, 0.0, 0.2), rotation=turn)
        return cloth.gravity, np.empty((0, 3)), [plane(0.5), rod]

    cloth.set_state(start, bodies=motion(0.0)[2])
    cloth.advance(0.9, motion)
    # A calm cloth has long steps, in which the rod turns far.
    assert cloth.time - cloth.last_begin > 0.1
    uneven = uneven_until(0.9, cloth, lambda time: motion(min(time, stops_at)))
    assert uneven is not None
    return uneven


@pytest.mark.physics
def test_an_even_turn_is_even_however_far_it_goes() -> None:
    assert unevenness(stops_at=2.0) < 1e-12


@pytest.mark.physics
def test_a_turn_that_stops_before_the_last_frame_is_uneven() -> None:
    """It stops half way to the frame, which leaves 9 mrad at arms of 0.1 m and more."""
    assert unevenness(stops_at=0.8875) > 9e-4


def test_rotation_vectors_come_back_from_their_matrices() -> None:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(200, 3))
    # Lengths from 0 to nearly half a turn.
    lengths = np.append(0.0, 10.0 ** np.linspace(-9.0, np.log10(3.1), 199))
    vectors *= (lengths / np.linalg.norm(vectors, axis=1))[:, None]
    back = vectors_of_matrices(matrices_of_vectors(vectors))
    assert np.abs(back - vectors).max() < 1e-9
