"""Frames between the ends of steps: no vertex is in a body, and no cloth crosses a surface."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from stickslip_sim_core import Cloth, SelfContact, Surface, fabric, preset_named
from stickslip_sim_core._sim_core import body_gaps, self_intersections
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import meshes
from stickslip_sim_core.cloth.contact import Body, box, capsule, cylinder, plane, sphere
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.scenes.frames import Frame, frame_at
from stickslip_sim_core.scenes.motions import rotation

RATE = 700
"""Frames in a second [1/s]: more than steps, so that most lie within one."""

COARSE = replace(preset_named("certified"), step_error=None, time_step=1 / 512)
"""Steps as long as those of a flat landing. The step control has shorter ones in other impacts."""


def thrown(
    bodies: Callable[[float], Sequence[Body]],
    surfaces: Sequence[Surface] = (),
    seconds: float = 0.03,
) -> list[tuple[float, Floats, Frame]]:
    """Time, cubic positions and frame of a napkin that is thrown at what is below it, at 4 m/s."""
    mesh = meshes.grid(0.06, 0.06, 6, 6)
    touch = SelfContact(0.3, 5e-4) if surfaces else None
    cloth = Cloth(
        mesh,
        fabric("gray-interlock"),
        COARSE,
        surfaces=surfaces,
        self_contact=touch,
    )
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), 0.05)])
    cloth.set_state(start, np.tile([0.0, 0.0, -4.0], (len(start), 1)), bodies(0.0))
    gravity = np.tile([0.0, 0.0, -GRAVITY], (len(start), 1))
    frames = []
    for number in range(1, int(seconds * RATE) + 1):
        time = number / RATE
        cloth.advance(time, lambda t: (gravity, np.empty((0, 3)), bodies(t)))
        frames.append((time, cloth.positions_at(time), frame_at(cloth, time, bodies)))
    return frames


def depth(positions: Floats, bodies: Sequence[Body]) -> float:
    return max(float(-body_gaps(body.as_tuple(), positions)[0].min()) for body in bodies)


def shaken(time: float) -> list[Body]:
    """A ball that turns about a point 5 cm beside its middle, and comes up on its way."""
    turn = rotation([0.0, 6.0 * time, 0.0])
    return [sphere(0.3, 0.03, origin=turn @ np.array([-0.05, 0.0, 0.0]), rotation=turn)]


@pytest.mark.physics
@pytest.mark.parametrize(
    "bodies",
    [
        lambda _: [plane(0.3)],
        lambda _: [sphere(0.3, 0.03)],
        lambda _: [cylinder(0.3, 0.03, rotation=rotation([np.pi / 2, 0.0, 0.0]))],
        lambda _: [capsule(0.3, 0.03, 0.05, rotation=rotation([0.0, np.pi / 2, 0.0]))],
        lambda _: [box(0.3, [0.05, 0.05, 0.06], rounding=0.02), plane(0.3)],
        shaken,
    ],
    ids=["floor", "ball", "rod", "capsule", "box", "moving ball"],
)
def test_no_frame_is_in_a_body(bodies: Callable[[float], Sequence[Body]]) -> None:
    """The cubic is by more than 0.05 mm, in the step of the impact."""
    frames = thrown(bodies)
    assert max(depth(cubic, bodies(time)) for time, cubic, _ in frames) > 5e-5
    assert max(depth(frame.positions, bodies(time)) for time, _, frame in frames) <= 1.0001e-5


@pytest.mark.physics
def test_no_frame_crosses_a_mesh() -> None:
    """A net of two cells that is 0.1 m wide: the cubic does cross it, in the step of the impact."""
    net = meshes.grid(0.1, 0.1, 2, 2)
    points = np.column_stack([net.rest, 0.2 * net.rest[:, 0]])
    surface = Surface(net.triangles, points, 0.3, thickness=5e-4)

    def crosses(positions: Floats) -> int:
        mesh = meshes.grid(0.06, 0.06, 6, 6)
        both = np.concatenate([mesh.triangles, net.triangles + len(positions)], dtype=np.int32)
        return self_intersections(np.concatenate([positions, points]), both)

    frames = thrown(lambda _: [], [surface])
    assert any(crosses(cubic) for _, cubic, _ in frames)
    assert not any(crosses(frame.positions) for _, _, frame in frames)


@pytest.mark.physics
def test_a_vertex_that_a_holder_drives_into_a_body_is_shown_there() -> None:
    """What is in a body at the ends of steps is a fault of the run, which no frame hides."""
    mesh = meshes.grid(0.06, 0.06, 6, 6)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset_named("certified"), held=[0])
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), 1e-3)])
    cloth.set_state(start, bodies=[plane(0.3)])

    def bodies(_: float) -> list[Body]:
        return [plane(0.3)]

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        return cloth.gravity, start[[0]] - [0.0, 0.0, 0.02 * time], bodies(time)

    cloth.advance(0.301, motion)
    frame = frame_at(cloth, 0.301, bodies)
    assert cloth.time > 0.301
    assert frame.positions[0, 2] == pytest.approx(1e-3 - 0.02 * 0.301, abs=1e-5)
    assert np.delete(frame.positions[:, 2], 0).min() >= -1.0001e-5
