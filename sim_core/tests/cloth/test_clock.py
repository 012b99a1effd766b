"""Steps of the controller's choice: they depend on the scene, and not on how often it is filmed."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stickslip_sim_core import Body, Cloth, SolverSettings, box, fabric, plane, preset_named, sphere
from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.cloth.presets import STEP_ERROR
from stickslip_sim_core.cloth.solver import GRAVITY
from stickslip_sim_core.scenes.holders import Holder
from stickslip_sim_core.scenes.scene import ClothRun, Scene

CERTIFIED = preset_named("certified")
MATERIAL = fabric("gray-interlock")
PATCH = meshes.grid(0.06, 0.06, 4, 4)
STRIP = meshes.grid(0.02, 0.2, 2, 12)
TOP = np.flatnonzero(STRIP.rest[:, 1] > 0.1 - 1e-9)


def swing(
    frame_rate: float,
    preset: SolverSettings = CERTIFIED,
    grasp: tuple[float, float] = (0.0, np.inf),
) -> ClothRun:
    """A strip swings about its upper edge for 1 s, and is let go at the end of the grasp."""
    down = 0.1 - STRIP.rest[:, 1]
    start = np.column_stack([0.5 * down, STRIP.rest[:, 0], -np.sqrt(0.75) * down])
    gravity = np.tile([0.0, 0.0, -GRAVITY], (len(start), 1))
    return Scene(
        mesh=STRIP,
        fabrics=[MATERIAL],
        preset=preset,
        start=start,
        motion=lambda _: (gravity, []),
        holders=[Holder(TOP, lambda _: np.eye(3, 4), grasp)],
        frames=int(frame_rate) + 1,
        frame_rate=frame_rate,
        kernel="baseline",
    ).run()


def shaken(frame_rate: float) -> ClothRun:
    """A patch lies on a floor that shakes at 32 Hz, with its frames at the same place of each
    period.
    """

    def bodies(time: float) -> list[Body]:
        return [plane(1.0, origin=(2e-3 * (1.0 - np.cos(64.0 * np.pi * time)), 0.0, 0.0))]

    start = np.column_stack([PATCH.rest, np.zeros(len(PATCH.rest))])
    gravity = np.tile([0.0, 0.0, -GRAVITY], (len(start), 1))
    return Scene(
        mesh=PATCH,
        fabrics=[MATERIAL],
        preset=CERTIFIED,
        start=start,
        motion=lambda time: (gravity, bodies(time)),
        frames=int(frame_rate) + 1,
        frame_rate=frame_rate,
        kernel="baseline",
    ).run()


@pytest.mark.physics
@pytest.mark.parametrize(
    "run", [swing, shaken, lambda rate: swing(rate, replace(CERTIFIED, step_error=None))]
)
def test_every_frame_rate_films_the_same_run(run: Callable[[float], ClothRun]) -> None:
    reference = run(100)
    for rate in (1, 2, 10, 50):
        filmed = run(rate)
        assert filmed.labels["steps"] == reference.labels["steps"]
        assert filmed.positions.tobytes() == reference.positions[:: 100 // rate].tobytes()
        assert (
            filmed.record["contact_force"].tobytes()
            == reference.record["contact_force"][:: 100 // rate].tobytes()
        )


@pytest.mark.physics
def test_a_floor_that_shakes_between_frames_moves_the_cloth() -> None:
    """It throws the patch by 3 mm to and fro; with one step a frame nothing would move."""
    path = shaken(100).positions
    assert np.ptp(path[:, :, 0].mean(axis=1)) > 2e-3
    assert np.abs(path[1:, :, 2]).max() < 1e-6


def watched(
    bodies: Callable[[float], list[Body]],
    end: float,
    preset: SolverSettings = CERTIFIED,
    held: tuple[int, ...] = (),
) -> tuple[Cloth, Floats]:
    """A patch lies at rest on bodies that begin to move later.

    Return its mean x at 200 frames a second [m].
    """
    cloth = Cloth(PATCH, MATERIAL, preset, held=held, kernel="baseline")
    start = np.column_stack([PATCH.rest, np.zeros(len(PATCH.rest))])
    cloth.set_state(start, bodies=bodies(0.0))
    path = []
    for frame in range(1, round(200 * end) + 1):
        cloth.advance(frame / 200, lambda t: (cloth.gravity, start[list(held)], bodies(t)))
        path.append(cloth.positions_at(frame / 200)[:, 0].mean())
    return cloth, np.array(path)


@pytest.mark.physics
@pytest.mark.parametrize("begin", [0.5, 0.5123], ids=["at a step's end", "in a step"])
@pytest.mark.parametrize("frequency", [4.0, 8.0, 16.0, 24.0, 33.0, 37.3, 60.0])
def test_cloth_at_rest_feels_a_floor_that_begins_to_shake(frequency: float, begin: float) -> None:
    """It moves as a rigid block does: with the floor, or with |v'| = mu g."""
    size, dt = 2e-3, 1e-5

    def floor(time: float) -> float:
        return size * (1.0 - math.cos(2.0 * math.pi * frequency * max(time - begin, 0.0)))

    cloth, path = watched(lambda time: [plane(1.0, origin=(floor(time), 0.0, 0.0))], 0.8)
    x, v, before, block = 0.0, 0.0, floor(0.0), []
    for tick in range(1, 80_001):
        now = floor(tick * dt)
        u, before = (now - before) / dt, now
        v += min(max(u - v, -GRAVITY * dt), GRAVITY * dt)
        x += v * dt
        if tick % 500 == 0:
            block.append(x)
    sticks = size * (2.0 * np.pi * frequency) ** 2 < GRAVITY
    assert path == pytest.approx(block, abs=3e-5 if sticks else 3e-4)
    assert np.ptp(path) > size
    assert checks.failed(checks.values(checks.Seen(cloth, cloth.positions[None], 0))) == ("", "")


@pytest.mark.physics
@pytest.mark.parametrize("far", [1.0, 0.01, 0.0006])
@pytest.mark.parametrize(
    "preset", [CERTIFIED, replace(CERTIFIED, step_error=None)], ids=["steps", "fixed"]
)
def test_jumps_are_not_valid(far: float, preset: SolverSettings) -> None:
    """A body or a holder that is elsewhere from one instant to the next."""
    jumps = watched(lambda time: [plane(1.0, origin=(0.0, 0.0, far * (time >= 0.3)))], 0.4, preset)[
        0
    ]
    assert checks.failed(checks.values(checks.Seen(jumps, jumps.positions[None], 0)))[0] == "jumps"


@pytest.mark.physics
@pytest.mark.parametrize(
    ("stop", "jump", "code"),
    [
        (0.47, 0.0, ""),  # with the last frame, within a step: what follows is not shown
        (0.45, 0.0, "jumps"),
        (0.47, 0.01, "jumps"),  # which the last frame shows
    ],
)
def test_what_happens_after_the_last_frame_is_not_judged(
    stop: float, jump: float, code: str
) -> None:
    """A holder that stops at once from 0.8 m/s, and may jump as it does."""

    def pose(time: ArrayLike) -> Floats:
        at = np.asarray(time, float)
        place = 0.8 * np.minimum(at, stop) + jump * (at >= stop)
        poses: Floats = np.eye(3, 4) + np.eye(1, 12, 3).reshape(3, 4) * place[..., None, None]
        return poses

    start = np.column_stack([np.zeros(len(STRIP.rest)), STRIP.rest])
    gravity = np.tile([0.0, 0.0, -GRAVITY], (len(start), 1))
    run = Scene(
        mesh=STRIP,
        fabrics=[MATERIAL],
        preset=CERTIFIED,
        start=start,
        motion=lambda _: (gravity, []),
        holders=[Holder(TOP, pose)],
        frames=48,
        frame_rate=100.0,
    ).run()
    # A run that has jumped may end before its last frame.
    assert stop <= run.times[-1] <= 0.47
    assert run.code == code


@pytest.mark.physics
def test_what_moves_evenly_is_valid() -> None:
    """By 1 cm in 0.1 s, with an acceleration of 4 m/s^2; and a ball far away that jumps."""

    def bodies(time: float) -> list[Body]:
        share = min(max(time - 0.3, 0.0) / 0.1, 1.0)
        far = sphere(0.5, 0.03, origin=(5.0 + (time > 0.2), 0.0, 0.0))
        return [plane(1.0, origin=(0.01 * share * share * (3.0 - 2.0 * share), 0.0, 0.0)), far]

    cloth, path = watched(bodies, 0.5)
    assert path[-1] == pytest.approx(0.01, abs=1e-4)
    assert checks.failed(checks.values(checks.Seen(cloth, cloth.positions[None], 0))) == ("", "")


@pytest.mark.physics
def test_between_steps_frames_are_cubic() -> None:
    """A falling cloth is at -g t^2/2 at any time: the cubic has its velocities at both ends."""
    cloth = Cloth(PATCH, MATERIAL, replace(CERTIFIED, step_error=None, time_step=0.02))
    cloth.set_state(np.column_stack([PATCH.rest, np.zeros(len(PATCH.rest))]))
    gravity = cloth.gravity.copy()
    for time in np.linspace(0.001, 0.1, 34):
        cloth.advance(time, lambda _: (gravity, np.empty((0, 3)), []))
        fallen = -0.5 * GRAVITY * time * time
        assert cloth.positions_at(time)[:, 2] == pytest.approx(
            np.full(len(PATCH.rest), fallen), abs=1e-7
        )
    for time in (0.0, cloth.time + 1e-6):
        with pytest.raises(ValueError, match=r"time: must be in the last step, .* s, got"):
            cloth.positions_at(time)


@pytest.mark.physics
@pytest.mark.parametrize("step_error", [1e-4, None])
def test_steps_end_at_events(step_error: float | None) -> None:
    """What is let go at 0.437 s falls freely from then on, at any frame rate."""
    preset = replace(CERTIFIED, step_error=step_error)
    filmed, reference = swing(10, preset, (0.0, 0.437)), swing(100, preset, (0.0, 0.437))
    assert filmed.positions.tobytes() == reference.positions[::10].tobytes()
    held = reference.positions[:, TOP]
    assert (held[:44] == held[0]).all()
    assert held[44, :, 2].max() < held[0, :, 2].min()
    instants: list[float] = []
    cloth = Cloth(PATCH, MATERIAL, preset)
    cloth.set_state(np.column_stack([PATCH.rest, np.zeros(len(PATCH.rest))]))
    still = np.zeros((len(PATCH.rest), 3))

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        instants.append(time)
        return still, np.empty((0, 3)), []

    cloth.advance(0.437, motion, event=0.437)
    assert cloth.time == instants[-1] == 0.437
    with pytest.raises(ValueError, match=r"event: must be after 0\.437 s, got 0\.437"):
        cloth.advance(1.0, motion, event=0.437)


@pytest.mark.physics
def test_the_step_error_is_what_a_step_misplaces() -> None:
    """A strip that swings has the error that the preset allows. With steps of a tenth of a second
    it has one that no frame may show.
    """
    good = swing(10)
    assert 0.0 < good.labels["step_error"] < 2e3 * STEP_ERROR
    assert good.valid
    coarse = swing(10, replace(CERTIFIED, step_error=None, time_step=0.1))
    assert coarse.labels["step_error"] > 10.0
    assert coarse.code == "step_error"
    short = swing(10, replace(CERTIFIED, step_error=None, time_step=5e-4))
    assert short.labels["step_error"] < 0.1


@pytest.mark.physics
def test_a_run_ends_where_its_iterations_are_spent() -> None:
    run = swing(10, replace(CERTIFIED, newton_per_second=40))
    assert run.code == "budget"
    assert run.labels["budget"] > 1.0
    assert len(run.positions) < 11
    assert np.isfinite(run.positions).all()


@pytest.mark.physics
class TestController:
    @staticmethod
    def sliding(end: float, **change: object) -> Cloth:
        """A patch falls on a floor that begins to shake it."""
        cloth = Cloth(PATCH, MATERIAL, replace(CERTIFIED, **change), kernel="baseline")  # type: ignore[arg-type]
        cloth.set_state(np.column_stack([PATCH.rest, np.full(len(PATCH.rest), 0.01)]))
        gravity = np.tile([0.0, 0.0, -GRAVITY], (len(PATCH.rest), 1))

        def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
            x = 0.05 * (1.0 - np.cos(6.0 * max(time - 0.8, 0.0)))
            return (
                gravity,
                np.empty((0, 3)),
                [box(0.3, (1, 1, 1), rounding=0.02, origin=(x, 0.0, -0.5))],
            )

        cloth.advance(end, motion, event=end)
        return cloth

    def test_reruns_equal(self) -> None:
        first, second = self.sliding(2.0), self.sliding(2.0)
        assert first.positions.tobytes() == second.positions.tobytes()
        assert first.total.steps == second.total.steps
        assert first.total.unconverged == 0

    def test_smaller_error_takes_more_steps_and_is_nearer(self) -> None:
        fine = self.sliding(1.6, step_error=1e-6, longest_step=2**-9, finest=2)
        loose, tight = self.sliding(1.6, step_error=1e-3), self.sliding(1.6, step_error=1e-5)
        assert 16 <= loose.total.steps < tight.total.steps < fine.total.steps
        wrong = [float(np.abs(cloth.positions - fine.positions).max()) for cloth in (loose, tight)]
        assert wrong[1] < 0.7 * wrong[0]

    def test_fixed_steps(self) -> None:
        assert self.sliding(0.8, step_error=None, time_step=0.02).total.steps == 40


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"finest": 3}, r"finest: must be a power of two, 1 \.\.\. 4096, got 3"),
        ({"longest_step": 2.0}, "longest_step: must be above 0 and at most 1, got 2.0"),
        ({"step_error": 0.0}, "step_error: must be above 0 and at most 1, got 0.0"),
    ],
)
def test_refusals(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CERTIFIED, **change)  # type: ignore[arg-type]


def test_errors_of_the_motion_come_through() -> None:
    cloth = Cloth(PATCH, MATERIAL, CERTIFIED)
    cloth.set_state(np.column_stack([PATCH.rest, np.zeros(len(PATCH.rest))]))

    def motion(time: float) -> tuple[Floats, Floats, list[Body]]:
        raise KeyError(f"no motion at {time}")

    with pytest.raises(KeyError, match="no motion at"):
        cloth.advance(0.1, motion)
