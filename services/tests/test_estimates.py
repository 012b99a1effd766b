"""Estimates of jobs before their submission, from the tasks that a service has measured."""

from collections.abc import Mapping
from typing import Any

import pytest
from sqlalchemy import insert, text
from stickslip_schemas.base import Stage
from stickslip_services.database.tables import cost_groups
from stickslip_services.queue.context import Context
from stickslip_services.queue.estimate import validate_spec
from stickslip_services.queue.submit import submit_job
from stickslip_testing.jobs import parsed, rods
from stickslip_testing.worker import PretendWorker

pytestmark = pytest.mark.databases(slow=True)


def measure(context: Context, kind: str, stage: Stage, group: str, seconds: float) -> None:
    """Store that ten calls of a cost group took so long each [s]."""
    row = {
        "stage": stage,
        "kind": kind,
        "cost_group": group,
        "count": 10,
        "wall_sum": 10 * seconds,
        "wall_squares": 10 * seconds**2,
        "call_sum": 10 * seconds,
        "call_squares": 10 * seconds**2,
    }
    with context.database.write() as connection:
        connection.execute(insert(cost_groups).values(row))


def medians(context: Context, spec: Mapping[str, Any]) -> dict[Stage, float]:
    """Return the estimated CPU time of each stage that was measured [s]."""
    estimate = validate_spec(context, parsed(dict(spec))).estimate
    return {stage: estimate.stages[stage].median for stage in estimate.measured}


def test_tasks_that_samples_share_count_once(context: Context) -> None:
    """Six samples of three textures have two simulations and six renders."""
    spec = {
        "kind": "cloth_drag",
        "axes": {
            "mu": [0.2, 0.4],
            "material": ["gray-interlock"],
            "texture": ["plaid", "dots", "stripes"],
            "viewpoint": ["calibrated"],
            "substrate": ["cloth"],
        },
        "quality": "draft",
    }
    parsed_spec = parsed(spec)
    for stage, seconds in ((Stage.simulate, 7.0), (Stage.render, 3.0)):
        for group in {parsed_spec.cost_group(stage, point) for point in parsed_spec.grid()}:
            measure(context, "cloth_drag", stage, group, seconds)
    assert medians(context, spec) == {
        Stage.simulate: pytest.approx(2 * 7.0),
        Stage.render: pytest.approx(6 * 3.0),
    }


def test_cpu_time_is_that_of_jobs_of_the_kind(context: Context, worker: PretendWorker) -> None:
    """Costs are measured in wall time: how much of it is CPU time differs between kinds."""
    for kind, cpu_seconds, gamma in (("rod_hang", 0.5, 1.0), ("cloth_drag", 4.0, 2.0)):
        spec = parsed(rods(gamma=(gamma,), phi1=(1.0, 2.0, 3.0, 4.0)))
        job = submit_job(context, spec, None).id  # type: ignore[union-attr]
        for lease in worker.lease(simulate=4):
            seconds = {"wall_seconds": 1.0, "call_seconds": 1.0, "cpu_seconds": cpu_seconds}
            worker.report((lease, worker.result(lease.task).model_copy(update=seconds)))
        with context.database.write() as connection:
            of_kind = text("UPDATE jobs SET kind = :kind WHERE id = :job")
            connection.execute(of_kind, {"kind": kind, "job": job})
    measured = medians(context, rods(gamma=(5.0,), phi1=(1.0, 2.0)))
    assert measured[Stage.simulate] == pytest.approx(2 * 1.0 * 0.5)
