"""Ended jobs leave the queue piece by piece, and only they do."""

from itertools import pairwise
from typing import Any

import pytest
from sqlalchemy import func, select
from stickslip_schemas.base import JobState, Stage
from stickslip_services.database.tables import jobs, ready_tasks
from stickslip_services.queue import leaving
from stickslip_services.queue.background import services, start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job
from stickslip_services.queue.leaving import QueueCleaner
from stickslip_services.queue.planner import Planner
from stickslip_services.queue.submit import submit_job
from stickslip_services.settings import Settings
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.worker import DirectApi, PretendWorker

pytestmark = pytest.mark.databases

PIECE = 3


def submit(context: Context, **spec: Any) -> str:
    return submit_job(context, parsed(rods(**spec)), None).id  # type: ignore[union-attr]


def queued(context: Context, job: str) -> dict[str, int]:
    """Return the numbers of rows of a job in the queue, by stage."""
    query = (
        select(ready_tasks.c.stage, func.count())
        .join(jobs, jobs.c.seq == ready_tasks.c.job)
        .where(jobs.c.id == job)
        .group_by(ready_tasks.c.stage)
    )
    with context.database.read() as connection:
        assert violations(connection) == []
        return {stage: count for stage, count in connection.execute(query)}


def test_a_cancelled_job_leaves_in_pieces_and_others_stay(
    context: Context, worker: PretendWorker
) -> None:
    job = submit(context, gamma=(1.0, 2.0, 3.0, 4.0))
    other = submit(context, gamma=(4.0, 5.0))  # shares tasks with the first
    leases = worker.lease(simulate=1)
    worker.report(*((lease, worker.result(lease.task)) for lease in leases))
    before, of_other = queued(context, job), queued(context, other)
    assert before[Stage.simulate] > 2 * PIECE
    assert before[Stage.render] > 0
    cleaner = QueueCleaner(context, piece=PIECE)
    assert not cleaner.step(), "no job has ended"

    assert cancel_job(context, job).state is JobState.cancelled
    numbers = [sum(before.values())]
    while cleaner.step():
        numbers.append(sum(queued(context, job).values()))
        assert queued(context, other) == of_other
    removed = [earlier - later for earlier, later in pairwise(numbers)]
    simulations, renders = before[Stage.simulate], before[Stage.render]
    pieces = [*_pieces_of(simulations), *_pieces_of(renders)]
    assert removed == [*pieces, 0], "the last step tells that the job has left"
    worker.work()
    assert show_job(context, other).state is JobState.succeeded
    assert queued(context, job) == {}


def _pieces_of(count: int) -> list[int]:
    full, rest = divmod(count, PIECE)
    return [PIECE] * full + ([rest] if rest else [])


def test_renders_leave_that_were_planned_before_the_last_simulations(
    settings: Settings, clock: ManualClock
) -> None:
    """Stages are removed one after the other, and pieces of a plan mix their numbers."""
    context = Context.open(settings.model_copy(update={"plan_samples": 4}), clock)
    start(context)
    worker = PretendWorker(DirectApi(context), context.store).register()
    job = submit(context, gamma=(1.0, 2.0, 3.0))
    Planner(context).run()
    worker.finish(*worker.lease(simulate=2))
    assert set(queued(context, job)) == {Stage.simulate, Stage.render}
    assert cancel_job(context, job).state is JobState.cancelled
    cleaner = QueueCleaner(context, piece=PIECE)
    while cleaner.step():
        pass
    assert queued(context, job) == {}
    context.close()


def test_a_job_that_waits_for_workers_stays_until_it_is_cancelled(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(context)
    leases = worker.lease(simulate=1)
    assert cancel_job(context, job).state is JobState.cancelling
    cleaner = QueueCleaner(context, piece=PIECE)
    assert not cleaner.step()
    assert queued(context, job) != {}
    worker.report(*((lease, None) for lease in leases))
    sweep(context)
    assert show_job(context, job).state is JobState.cancelled
    while cleaner.step():
        pass
    assert queued(context, job) == {}


def test_the_next_coordinator_goes_on(settings: Settings, clock: ManualClock) -> None:
    context = Context.open(settings, clock)
    start(context)
    PretendWorker(DirectApi(context), context.store).register()
    job = submit(context, gamma=(1.0, 2.0, 3.0))
    cancel_job(context, job)
    count = sum(queued(context, job).values())
    assert QueueCleaner(context, piece=PIECE).step()
    context.close()

    context = Context.open(settings, clock)
    start(context)
    assert sum(queued(context, job).values()) == count - PIECE
    assert QueueCleaner(context, piece=PIECE).step()
    # Two coordinators may be at it at once.
    cleaners = [QueueCleaner(context, piece=PIECE) for _ in range(2)]
    while any([cleaner.step() for cleaner in cleaners]):
        pass
    assert queued(context, job) == {}
    context.close()


def test_the_services_of_a_coordinator_empty_the_queue_of_failed_jobs(
    context: Context, worker: PretendWorker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(leaving, "REST_SECONDS", 0.0)
    job = submit(context, gamma=(1.0, 2.0))
    with context.database.write() as connection:
        damage = jobs.update().where(jobs.c.id == job).values(certificate="damaged")
        connection.execute(damage)
    for service in services(context):
        service.run_once()
    assert show_job_state(context, job) == JobState.failed
    assert queued(context, job) == {}


def show_job_state(context: Context, job: str) -> str:
    """Return the state of a job, whose row may be damaged."""
    with context.database.read() as connection:
        return str(connection.scalar(select(jobs.c.state).where(jobs.c.id == job)))


def test_a_piece_reads_a_range_of_the_index(settings: Settings) -> None:
    """Otherwise each piece would read the rows of all jobs."""
    context = Context.open(settings)
    start(context)
    statements: list[str] = []
    with context.database.write() as connection:
        if connection.dialect.name == "sqlite":
            connection.exec_driver_sql(
                "INSERT INTO ready_tasks (task, job, stage, cost_group) VALUES (1, 1, 'pack', '')"
            )
            driver: Any = connection.connection.dbapi_connection
            driver.set_trace_callback(statements.append)
            QueueCleaner(context)._remove(connection, leaving._Position(1, Stage.pack, 0))
            driver.set_trace_callback(None)
            ranges = "ix_ready_tasks_lease (job=? AND stage=? AND task>?"
            for statement in statements[:2]:
                plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}").all()
                assert ranges in str(plan)
            assert connection.exec_driver_sql("SELECT count(*) FROM ready_tasks").scalar() == 0
    context.close()
