"""A run that has failed a check ends at once, and no other run ends early."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stickslip_sim_core import Body, SelfContact, box, fabric, plane, preset_named
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.scenes.holders import Holder
from stickslip_sim_core.scenes.scene import ClothRun, Scene

pytestmark = pytest.mark.physics

SECONDS = 2.0


def lowered(depth: float) -> Scene:
    """A square that hangs from an edge, which goes down by a depth [m] within a second.

    The edge starts 0.1 m above a floor.
    """
    mesh = meshes.grid(0.1, 0.1, 6, 6)
    # A slight bow says to which side the sheet gives way. A plane one would be pressed in its plane
    # until rounding bends it, and would then spring. With 2 mm in place of 3 `fast` buckles into
    # another branch than steps of 0.5 ms do, and `stretch` fails as well.
    bow = 0.003 * np.cos(np.pi * mesh.rest[:, 1] / 0.1)
    start = np.column_stack([bow, mesh.rest[:, 0], mesh.rest[:, 1] + 0.051])
    held = np.flatnonzero(mesh.rest[:, 1] > 0.0499)

    def pose(time: ArrayLike) -> Floats:
        return np.column_stack([np.eye(3), [0.0, 0.0, -depth * min(float(np.asarray(time)), 1.0)]])

    gravity = np.tile([0.0, 0.0, -9.81], (len(start), 1))
    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock")],
        preset=preset_named("fast"),
        start=start,
        motion=lambda _time: (gravity, [plane(0.5)]),
        holders=[Holder(held, pose)],
        frames=int(SECONDS * 10) + 1,
        frame_rate=10.0,
    )


@pytest.fixture(scope="module")
def sunk() -> ClothRun:
    """The holders go 5 cm into the floor."""
    return lowered(0.15).run()


def test_a_lost_run_ends_soon_after_it_fails(sunk: ClothRun) -> None:
    # The holders reach the floor after 0.67 s.
    assert sunk.code == "penetration"
    assert sunk.times[-1] < 1.0


def test_a_run_that_ends_late_has_the_same_verdict(
    sunk: ClothRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(checks.Verdict, "_look", lambda _verdict: None)
    whole = lowered(0.15).run()
    assert whole.times[-1] == SECONDS
    assert whole.code == sunk.code
    both = len(sunk.positions)
    assert np.array_equal(whole.positions[:both], sunk.positions)


def test_a_valid_run_is_not_changed_by_the_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    judged = lowered(0.08).run()
    monkeypatch.setattr(checks.Verdict, "_look", lambda _verdict: None)
    unseen = lowered(0.08).run()
    assert judged.valid
    assert judged.times[-1] == SECONDS
    assert np.array_equal(judged.positions, unseen.positions)
    assert {name: judged.labels[name] for name in judged.labels} == unseen.labels


def test_a_scene_without_a_valid_run_takes_no_step() -> None:
    run = replace(lowered(0.08), reason="no stable start").run()
    assert run.code == "solver_diverged"
    assert len(run.positions) == 1
    assert run.labels["steps"] == 0


def squeezed() -> Scene:
    """A napkin between a floor and a block that closes until both cross."""
    mesh = meshes.grid(0.1, 0.1, 8, 8)
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), 1e-3)])
    gravity = np.tile([0.0, 0.0, -9.81], (len(start), 1))

    def bodies(time: float) -> list[Body]:
        upper = box(0.5, (0.2, 0.2, 0.1), rounding=0.04, origin=(0.0, 0.0, 0.06 - 0.2 * time))
        return [plane(0.5), upper]

    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock")],
        preset=preset_named("certified"),
        start=start,
        motion=lambda time: (gravity, bodies(time)),
        frames=31,
        frame_rate=100.0,
    )


def test_it_is_not_valid_for_what_was_squeezed() -> None:
    run = squeezed().run()
    # A step without a solution ends the run, if nothing else did before.
    assert run.code in {"penetration", "contact_gain", "passages", "unconverged", "budget"}
    assert run.times[-1] < 0.1


def test_a_step_that_may_not_fail_is_given_up() -> None:
    assert _iterations(squeezed(), may_fail=False) < _iterations(squeezed(), may_fail=True)


def crushed() -> Scene:
    """A napkin that lies between four walls, which close until there is no room left for it."""
    mesh = meshes.grid(0.1, 0.1, 8, 8)
    # Heights by a fixed rule say to which side each part gives way.
    height = 1.05e-3 + 5e-5 * np.cos(150.0 * mesh.rest[:, 0]) * np.cos(110.0 * mesh.rest[:, 1])
    start = np.column_stack([mesh.rest, height])
    gravity = np.tile([0.0, 0.0, -9.81], (len(start), 1))

    def bodies(time: float) -> list[Body]:
        away = 0.252 - 0.2 * time
        sides = [(away, 0.0), (0.0, away), (-away, 0.0), (0.0, -away)]
        walls = [box(0.3, (0.2, 0.2, 0.2), rounding=0.0115, origin=(*at, 0.0)) for at in sides]
        return [plane(0.5), *walls]

    return Scene(
        mesh=mesh,
        fabrics=[fabric("gray-interlock")],
        preset=preset_named("certified"),
        start=start,
        motion=lambda time: (gravity, bodies(time)),
        self_contact=SelfContact(0.5),
        frames=41,
        frame_rate=40.0,
    )


@pytest.mark.slow
def test_a_step_without_a_solution_ends_the_run() -> None:
    run = crushed().run()
    assert not run.valid
    assert run.labels["budget"] > 1.0
    # The last try of the step may go beyond.
    assert run.labels["budget"] < 1.5


def _iterations(scene: Scene, *, may_fail: bool) -> int:
    """Return the iterations up to the first step that does not converge, with all of its own."""
    cloth = scene.begin().cloth
    cloth.advance(
        0.1,
        lambda time: (cloth.gravity, np.empty((0, 3)), scene.motion(time)[1]),
        is_over=lambda: cloth.total.unconverged > 0,
        may_fail=lambda: may_fail,
    )
    return cloth.total.newton
