"""Worst stretches of a run: the same seconds have the same values, whatever follows them."""

import math

import numpy as np
import pytest
from numpy.typing import ArrayLike

from stickslip_sim_core.arrays import Floats
from stickslip_sim_core.cloth import checks, meshes
from stickslip_sim_core.cloth.contact import plane
from stickslip_sim_core.cloth.fabrics import fabric
from stickslip_sim_core.cloth.history import worst_stretch
from stickslip_sim_core.cloth.presets import STEP_ERROR, SolverSettings, preset_named
from stickslip_sim_core.cloth.solver import Cloth

TAILS = (0, 1, 30, 600)
"""Numbers of calm steps that follow."""


def values(cloth: Cloth) -> dict[str, float]:
    return dict(checks.values(checks.Seen(cloth, cloth.positions[None], 0)))


@pytest.mark.parametrize(
    ("part", "whole", "most", "ratio"),
    [
        ([], [], 1.0, 0.0),
        ([0.0], [0.0], 1.0, 0.0),
        ([1.0], [0.0], 4.0, 0.25),  # of nothing: over the whole of a stretch
        ([1.0, 0.0, 1.0], [1.0, 1.0, 1.0], 3.0, 2.0 / 3.0),
        ([1.0, 0.0, 1.0], [1.0, 1.0, 1.0], 2.0, 0.5),
        ([6.0, 1.0], [8.0, 1.0], 1.0, 1.0),  # a step with more is a stretch by itself
        ([6.0, 0.0], [8.0, 1.0], 1.0, 0.75),
        ([1e-9, 1.0], [1e9, 1e-9], 1e-9, 1e9),  # `most` vanishes in the sum
        ([0.0, math.nan, 0.0], [1.0, 1.0, 1.0], 1.0, math.nan),
        ([0.0, 1.0, 0.0], [1.0, math.nan, 1.0], 1.0, math.nan),
    ],
)
def test_the_worst_stretch(
    part: list[float], whole: list[float], most: float, ratio: float
) -> None:
    stretch = worst_stretch(np.array(part), np.array(whole), most)
    assert stretch == pytest.approx(ratio, nan_ok=True)


def test_what_follows_mends_nothing_and_a_calm_end_adds_nothing() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        steps = rng.integers(1, 40)
        # Steps of very unequal wholes, as of an impact between calm ones.
        part, whole = (
            rng.random(steps) * (rng.random(steps) < 0.3),
            10.0 ** rng.uniform(-3, 1, steps),
        )
        stretch = worst_stretch(part, whole, 0.5)
        tail = 10.0 ** rng.uniform(-3, 1, 30)
        worse = worst_stretch(np.append(part, rng.random(30)), np.append(whole, tail), 0.5)
        calm = worst_stretch(np.append(part, np.zeros(30)), np.append(whole, tail), 0.5)
        assert worse >= stretch
        assert calm == stretch


def sheet(preset: SolverSettings, height: float, held: ArrayLike) -> tuple[Cloth, Floats]:
    mesh = meshes.grid(0.1, 0.1, 5, 5)
    cloth = Cloth(mesh, fabric("gray-interlock"), preset, held=held)
    start = np.column_stack([mesh.rest, np.full(len(mesh.rest), height)])
    cloth.set_state(start)
    return cloth, start


@pytest.mark.physics
def test_a_calm_end_does_not_hide_steps_that_did_not_converge() -> None:
    """A preset with one iteration cannot solve the steps on a floor that jolts, and solves rest."""
    preset = SolverSettings("hasty", 0.02, newton_max=1, halvings_max=0, step_error=None)
    shares = []
    for tail in TAILS:
        cloth, _ = sheet(preset, 0.0, ())
        for step in range(10 + tail):
            height = 0.01 * (1.0 - math.cos(2.0 * min(step, 10)))
            cloth.step(0.02, bodies=[plane(0.5, origin=(0.0, 0.0, height))])
        shares.append((values(cloth)["unconverged"], cloth.total.unconverged))
    assert shares[0][0] > 1.0
    assert all(share == shares[0] for share in shares)


@pytest.mark.physics
def test_a_calm_end_does_not_hide_what_a_body_pushed_out() -> None:
    """Held vertices 1 mm in a floor, which pushes them out when they are let go. A floor that
    carries the cloth up and down afterwards moves much energy, and takes none of it back.
    """
    held = np.arange(35)
    depths = []
    for tail in TAILS:
        cloth, start = sheet(preset_named("certified"), 5e-4, held)
        cloth.step(0.01, held=start[held] - [0.0, 0.0, 1.5e-3], bodies=[plane(0.5)])
        cloth.hold([], bodies=[plane(0.5)])
        for step in range(10 + tail):
            height = 0.01 * (1.0 - math.cos(0.05 * max(step - 10, 0)))
            cloth.step(0.02, bodies=[plane(0.5, origin=(0.0, 0.0, height))])
        depths.append(values(cloth)["contact_gain"])
    assert depths[0] > 1e-3
    assert depths == pytest.approx([depths[0]] * len(TAILS), rel=1e-9)


@pytest.mark.physics
def test_a_start_within_what_is_allowed_in_a_floor_gains_nothing() -> None:
    """0.9 um, where 1 um may be: two rounding errors are no work, and no flow of energy."""
    cloth, _ = sheet(preset_named("certified"), -9e-7, ())
    for _ in range(10):
        cloth.step(0.02, bodies=[plane(0.5)])
    assert checks.failed(values(cloth)) == ("", "")
    assert values(cloth)["contact_gain"] < 1e-9


@pytest.mark.parametrize(("share", "value"), [(0.0, math.inf), (0.002, 1.0), (1.0, 1.0)])
def test_a_preset_says_how_many_steps_may_stay_unconverged(share: float, value: float) -> None:
    preset = SolverSettings(
        "hasty", 0.02, newton_max=1, halvings_max=0, step_error=None, unconverged_share_max=share
    )
    cloth, _ = sheet(preset, 0.0, ())
    assert values(cloth)["unconverged"] == 0.0
    # The second step reaches the floor, which takes more than one iteration.
    for _ in range(2):
        cloth.step(0.02, bodies=[plane(0.5, origin=(0.0, 0.0, -0.005))])
    assert cloth.total.unconverged == 1
    assert values(cloth)["unconverged"] == pytest.approx(value)


def give_history(cloth: Cloth, monkeypatch: pytest.MonkeyPatch, **columns: ArrayLike) -> None:
    """Let a cloth have taken steps with these values."""
    monkeypatch.setattr(cloth.history, "column", lambda name: np.asarray(columns[name]))


def value_of(name: str, state: checks.Seen) -> float:
    return next(check for check in checks.CHECKS if check.name == name).value(state)


@pytest.mark.parametrize(("end", "largest"), [(None, 9e-4), (2e-5, 1e-4)])
def test_motion_after_the_last_frame_is_no_jump(
    end: float | None, largest: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloth, start = sheet(preset_named("certified"), 0.01, ())
    give_history(cloth, monkeypatch, motion_error=[1e-4, 9e-4])
    state = checks.Seen(cloth, start[None], 0, motion_error_end=end)
    assert value_of("jumps", state) == pytest.approx(largest / STEP_ERROR)


def test_work_is_judged_against_what_lifts_the_cloth_by_cells(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where no energy flows."""
    cloth, start = sheet(preset_named("certified"), 0.01, ())
    give_history(cloth, monkeypatch, contact_work=[1e-6], flow=[0.0])
    cell = 0.1 / (np.sqrt(len(start)) - 1.0)
    lift = checks.FLOW * cloth.masses.sum() * 9.81 * cell
    assert value_of("contact_gain", checks.Seen(cloth, start[None], 0)) == pytest.approx(
        1e-6 / lift
    )


@pytest.mark.parametrize(("calm", "may_fail"), [(498, False), (499, True)])
def test_a_step_may_fail_where_none_of_500_has(
    calm: int, may_fail: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    cloth, _ = sheet(preset_named("certified"), 0.01, ())
    give_history(cloth, monkeypatch, unconverged=[1.0] + [0.0] * calm)
    assert checks.Verdict(cloth).allows_failure() == may_fail
