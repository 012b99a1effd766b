"""What a job costs: packaged costs of the kinds, and costs that a service has measured."""

from typing import Any

import pytest
from stickslip_schemas.base import Stage
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.costs import (
    JOB_SECONDS,
    Estimate,
    Interval,
    MachineSpeed,
    count,
    estimate_cost,
)
from stickslip_schemas.spec.names import Texture


def estimate(
    slots: int = 2,
    measured: dict[Stage, Interval] | None = None,
    speed: MachineSpeed | None = None,
    **document: Any,
) -> Estimate:
    spec = job_spec_adapter.validate_python(document)
    return estimate_cost(spec, count(spec), measured or {}, slots, speed)


def rods(number: int, quality: str) -> dict[str, Any]:
    gamma = {"type": "linspace", "start": 100.0, "stop": 1300.0, "num": number}
    return {
        "kind": "rod_hang",
        "axes": {"gamma": gamma, "phi0": 1.0, "phi1": 6.0},
        "quality": quality,
    }


def clips(*textures: str, mu: Any = 0.3, **more: Any) -> dict[str, Any]:
    axes = {"material": "gray-interlock", "mu": mu, "texture": list(textures), "viewpoint": "left"}
    return {"kind": "cloth_drag", "axes": axes, **more}


@pytest.mark.parametrize(
    ("document", "stage", "cost"),
    [
        (rods(24, "high"), Stage.render, 16.9),
        (rods(20, "draft"), Stage.render, 2.1),
        (clips("checker", frames=30), Stage.render, 50.0),
        # 8.6 were measured with one measured frame: there are four now, of 0.98 s each.
        (clips("stripes", frames=6), Stage.render, 11.5),
        (clips(*list(Texture)[:8], frames=30), Stage.render, 68.0),
        (clips("dots", frames=24, quality="high"), Stage.render, 105.8),
        (clips("plaid", "dots", "gingham", frames=6, quality="high"), Stage.render, 35.7),
        (clips("checker", frames=30, quality="draft"), Stage.render, 38.3),
        (clips("dots", "checker", mu=[0.2, 0.6], mesh=21, preset="fast"), Stage.simulate, 10.8),
        (clips("dots", mesh=41), Stage.simulate, 31.0),
    ],
)
def test_packaged_costs_fit_the_jobs_that_they_were_taken_from(
    document: Any, stage: Stage, cost: float
) -> None:
    """Not a check of accuracy: these jobs gave the numbers. It holds the units and the counts."""
    estimated = estimate(**document).stages[stage]
    assert estimated.median == pytest.approx(cost, rel=0.4)
    assert estimated.low < cost < estimated.high


def test_what_was_measured_replaces_what_is_usual() -> None:
    known = Interval(median=100.0, low=90.0, high=120.0)
    costs = estimate(slots=4, measured={Stage.simulate: known}, **clips("dots", frames=10))
    assert costs.stages[Stage.simulate] == known
    assert costs.measured == (Stage.simulate,)
    assert costs.cpu_seconds.median == pytest.approx(
        sum(stage.median for stage in costs.stages.values())
    )
    assert costs.wall_seconds is not None
    # One simulation, one shading: the four slots cannot share them.
    assert costs.wall_seconds.high == pytest.approx(costs.cpu_seconds.high + JOB_SECONDS)
    assert estimate(slots=0, **rods(2, "draft")).wall_seconds is None


def test_packaged_costs_follow_the_speed_of_the_machine() -> None:
    here = estimate(slots=2, **rods(1000, "draft"))
    slow = estimate(slots=2, speed=MachineSpeed(cpu_speed=0.5), **rods(1000, "draft"))
    half = estimate(slots=2, speed=MachineSpeed(cpu_available=0.5), **rods(1000, "draft"))
    assert slow.cpu_seconds.median == pytest.approx(2 * here.cpu_seconds.median)
    assert half.cpu_seconds == here.cpu_seconds


def test_few_tasks_have_what_a_quota_leaves_to_all_slots() -> None:
    """A quota of one CPU: one task has all of it, and each of two tasks has half."""
    quota = MachineSpeed(cpu_available=0.5, cpu_alone=1.0)

    def work_of(texture_and_size: dict[str, Any], speed: MachineSpeed) -> float:
        costs = estimate(slots=2, speed=speed, **texture_and_size)
        assert costs.wall_seconds is not None
        return costs.wall_seconds.median - JOB_SECONDS

    # One simulation and one shading are alone, with and without the quota.
    assert work_of(clips("dots"), quota) == pytest.approx(work_of(clips("dots"), MachineSpeed()))
    # A job of many tasks takes as long as its CPU time, which two slots would halve.
    many = rods(1000, "high")
    assert work_of(many, quota) == pytest.approx(2 * work_of(many, MachineSpeed()), rel=0.01)
    # A third of a CPU is all that one task can have, too.
    third = MachineSpeed(cpu_available=1 / 6, cpu_alone=1 / 3)
    assert work_of(clips("dots"), third) == pytest.approx(3 * work_of(clips("dots"), quota))


def test_a_measured_stage_does_not_follow_the_speed() -> None:
    known = Interval(median=100.0, low=90.0, high=120.0)
    speed = MachineSpeed(cpu_speed=0.1)
    costs = estimate(measured={Stage.simulate: known}, speed=speed, **clips("dots"))
    assert costs.stages[Stage.simulate] == known


def test_textures_share_a_shading_and_nothing_is_rendered_without_views() -> None:
    single, four = (
        estimate(**clips(*names)).stages[Stage.render].median
        for names in (["dots"], ["dots", "plaid"])
    )
    assert four < 1.5 * single
    assert estimate(**(rods(20, "high") | {"views": None})).stages[Stage.render].high == 0.0


def test_an_unknown_scene_says_how_little_is_known() -> None:
    axes = {"texture": "dots", "viewpoint": "front"}
    costs = estimate(kind="cloth_scene", scene="turning-ball", axes=axes).stages[Stage.simulate]
    assert costs.high == pytest.approx(100 * costs.low)


@pytest.mark.parametrize(
    ("number", "splits"),
    [
        (7, {"train": 6, "validation": 0, "test": 1}),  # bounds 5.6 and 6.3
        (15, {"train": 12, "validation": 2, "test": 1}),  # 12 and 13.5
        (100, {"train": 80, "validation": 10, "test": 10}),
    ],
)
def test_expected_splits_are_rounded_and_add_up(number: int, splits: dict[str, int]) -> None:
    assert count(job_spec_adapter.validate_python(rods(number, "draft"))).expected_splits == splits
