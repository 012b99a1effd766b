"""Tasks that several jobs need, one after the other: what a new job finds, and what it repairs."""

from typing import Any

import pytest
from sqlalchemy import select, text
from stickslip_schemas.base import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.responses import JobDetail
from stickslip_schemas.documents.tasks import PackOutput
from stickslip_schemas.store import DirectoryStore
from stickslip_services.database.tables import tasks
from stickslip_services.queue.background import sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job
from stickslip_services.queue.maintenance import remove
from stickslip_services.queue.submit import submit_job
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.worker import PretendWorker, failure, rejection

pytestmark = pytest.mark.databases(slow=True)


def submit(context: Context, **spec: Any) -> str:
    return submit_job(context, parsed(rods(**spec)), None).id  # type: ignore[union-attr]


def finish(
    context: Context,
    worker: PretendWorker,
    clock: ManualClock,
    job: str,
    state: JobState = JobState.succeeded,
) -> JobDetail:
    """Work until the job has ended in a state, and return it."""
    for _ in range(6):
        worker.work()
        clock.advance(10)
        sweep(context)
    detail = show_job(context, job)
    assert detail.state is state, detail.message
    with context.database.read() as connection:
        assert violations(connection) == []
    return detail


def damage_first_shard(context: Context, worker: PretendWorker) -> None:
    """Overwrite a file of the first pack task."""
    with context.database.read() as connection:
        packs = select(tasks.c.output).where(tasks.c.stage == Stage.pack).order_by(tasks.c.seq)
        output = PackOutput.model_validate_json(str(connection.scalars(packs).first()))
    assert isinstance(worker.store, DirectoryStore)
    worker.store.path(output.files[0].sha256).write_bytes(b"x")


def test_a_shared_shard_outlives_the_job_that_planned_it_first(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    """A pack task reads the slots of a job: of one that needs it, and not of one that was ended."""
    cancel_job(context, submit(context))
    large = submit(context, gamma=(1.0, 2.0, 3.0))
    small = finish(context, worker, clock, submit(context)).dataset
    finish(context, worker, clock, large)
    assert small is not None
    # Two jobs of the small grid go: the one that was cancelled, and the one that made the version.
    assert remove(context.database, context.store, small.dataset, small.version)[0] == 2

    # The first shard of the large dataset, which the small one shared, is damaged.
    damage_first_shard(context, worker)
    worker.finished_ids.clear()
    finish(context, worker, clock, submit(context, gamma=(1.0, 2.0, 3.0)))
    assert [name.partition("-")[0] for name in worker.finished_ids] == ["pack", "publish"]


def test_a_damaged_rejection_of_a_render_is_restored_and_nothing_is_rendered(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(context, phi1=(1.0,))
    rejected, valid = worker.lease(simulate=2)
    worker.report((rejected, rejection()))
    worker.finish(valid)
    worker.finish(*worker.lease(render=2))
    with context.database.write() as connection:
        damage = "UPDATE tasks SET message = 'x' WHERE stage = 'render' AND state = 'rejected'"
        connection.execute(text(damage))
    assert worker.lease(pack=1) == ()
    sweep(context)
    assert show_job(context, job).reason is Reason.damaged_row

    worker.finished_ids.clear()
    ended = JobState.succeeded_with_rejects
    again = finish(context, worker, clock, submit(context, phi1=(1.0,)), ended)
    assert {name.partition("-")[0] for name in worker.finished_ids} == {"pack", "publish"}
    assert again.progress.stages[Stage.render].counts == {
        TaskState.succeeded: 1,
        TaskState.rejected: 1,
    }


def test_a_task_that_nobody_needed_any_more_gets_all_its_tries(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    tries = context.settings.max_tries
    first = submit(context, gamma=(1.0,), phi1=(1.0,))
    for _ in range(tries - 1):
        worker.report((worker.lease(simulate=1)[0], failure()))
        clock.advance(60)
        sweep(context)
    (lease,) = worker.lease(simulate=1)
    worker.report((lease, None))  # back to the queue, with one try left
    cancel_job(context, first)

    second = submit(context, gamma=(1.0,), phi1=(1.0,))
    for _ in range(tries - 1):
        worker.report((worker.lease(simulate=1)[0], failure()))
        clock.advance(60)
        sweep(context)
    assert show_job(context, second).state is JobState.running
    finish(context, worker, clock, second)


def test_a_job_that_found_its_results_costs_nothing(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    """Even if one of them was damaged, and its task ran again."""
    first = finish(context, worker, clock, submit(context))
    damage_first_shard(context, worker)
    worker.finished_ids.clear()
    second = finish(context, worker, clock, submit(context))
    assert [name.partition("-")[0] for name in worker.finished_ids] == ["pack", "publish"]
    assert min(stage.cpu_seconds for stage in first.progress.stages.values()) > 0.0
    assert {stage.cpu_seconds for stage in second.progress.stages.values()} == {0.0}
