"""The rules of leasing, each by itself: fencing, expiry, retries, back-off, losses, priorities,
cancelling, quotas.
"""

import asyncio
import threading
from typing import Any

import pytest
from sqlalchemy import select
from stickslip_schemas.base import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.tasks import PackTask
from stickslip_schemas.documents.worker_api import Heartbeat, LeaseRequest, LeaseState
from stickslip_services.access.principals import Principal, acting_as
from stickslip_services.access.quotas import check_quota, find_project, set_quota
from stickslip_services.api.routes.workers import Batcher
from stickslip_services.database.database import PageRequest
from stickslip_services.database.tables import tasks
from stickslip_services.errors import ConflictError, QuotaExceededError, UnknownWorkerError
from stickslip_services.queue.background import start, sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job
from stickslip_services.queue.heartbeat import reconcile_leases, renew_leases
from stickslip_services.queue.ids import task_key
from stickslip_services.queue.jobs import find_job, list_samples
from stickslip_services.queue.lease import lease_tasks
from stickslip_services.queue.submit import submit_job
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.worker import DirectApi, PretendWorker, failure, rejection


def submit(context: Context, *, priority: int = 0, project: str = "", **spec: Any) -> str:
    with acting_as(Principal(project=project)):
        return submit_job(context, parsed(rods(**spec)), priority=priority).id  # type: ignore[union-attr]


def row(context: Context, task_id: str) -> Any:
    """Return the row of a task."""
    with context.database.read() as connection:
        return connection.execute(select(tasks).where(tasks.c.key == task_key(task_id))).one()


def gammas(leases: Any) -> list[float]:
    return [lease.task.simulation.gamma for lease in leases]


@pytest.mark.parametrize("is_leased", [False, True])
def test_cancelling_a_job_frees_its_quota(
    context: Context, worker: PretendWorker, is_leased: bool
) -> None:
    with context.database.write() as connection:
        set_quota(connection, "lab", max_samples=4, max_jobs=1, now=context.clock())
    job_id = submit(context, project="lab")
    leases = worker.lease(simulate=1) if is_leased else ()
    with context.database.read() as connection, pytest.raises(QuotaExceededError):
        check_quota(connection, "lab", 1)
    cancel_job(context, job_id)
    worker.beat(*leases)
    sweep(context)
    with context.database.read() as connection:
        project = find_project(connection, "lab")
        assert (project.samples, project.jobs) == (0, 0)
        check_quota(connection, "lab", 4)
    submit(context, project="lab", gamma=(8.0, 9.0))


@pytest.mark.parametrize("cancelled", [0, 1])
def test_a_started_task_of_a_cancelled_job_runs_on_for_another_job(
    context: Context, worker: PretendWorker, cancelled: int
) -> None:
    """The need of the job that needs it most decides, in whatever order the jobs are read."""
    jobs = [submit(context, gamma=(1.0, 2.0 + n), phi1=(1.0,)) for n in (0, 1)]
    leases = worker.lease(simulate=3)
    alone = gammas(leases).index(2.0 + cancelled)
    # The cancelled job has a task of its own on lease, so it is `cancelling` until that is dropped.
    cancel_job(context, jobs[cancelled])
    assert show_job(context, jobs[cancelled]).state is JobState.cancelling
    assert worker.start(*leases) == (leases[alone].task_id,)
    sweep(context)
    assert show_job(context, jobs[cancelled]).state is JobState.cancelled
    assert worker.finish(leases[gammas(leases).index(1.0)]) == ["accepted"]


@pytest.mark.parametrize("settings", [{"max_tries": 5, "retry_seconds": 3.0}], indirect=True)
def test_the_wait_before_a_retry_doubles(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context, gamma=(1.0,), phi1=(1.0,))
    for tries, wait in enumerate((3.0, 6.0, 12.0, 24.0), start=1):
        (lease,) = worker.lease(simulate=1)
        worker.report((lease, failure()))
        failed = row(context, lease.task_id)
        assert (failed.state, failed.tries, failed.retry_at) == (
            TaskState.soft_failed,
            tries,
            clock.now + wait,
        )
        clock.advance(wait - 0.01)
        sweep(context)
        assert worker.lease() == ()
        clock.advance(0.01)


def test_unstarted_tasks_of_a_lost_worker_are_not_charged(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context)
    started, unstarted = worker.lease(simulate=2)
    worker.start(started)
    clock.advance(31)
    sweep(context)
    lost, waiting = row(context, started.task_id), row(context, unstarted.task_id)
    assert (lost.state, lost.attempts, lost.losses, lost.tries) == (TaskState.pending, 1, 1, 0)
    assert (waiting.state, waiting.attempts, waiting.losses, waiting.tries) == (
        TaskState.pending,
        0,
        0,
        0,
    )


def test_each_lease_of_a_task_has_a_higher_token(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context, gamma=(1.0,), phi1=(1.0,))
    tokens = []
    for _ in range(3):
        (lease,) = worker.lease(simulate=1)
        tokens.append(lease.token)
        clock.advance(31)
        sweep(context)
    assert tokens == [1, 2, 3]


def test_the_holder_of_an_earlier_lease_is_fenced_off(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    """The same worker leases a task twice: its message about the first lease is stale."""
    submit(context, gamma=(1.0,), phi1=(1.0,))
    (old,) = worker.lease(simulate=1)
    clock.advance(31)
    (new,) = worker.lease(simulate=1)
    assert worker.beat(old) == (old.task_id,)
    assert worker.report((old, worker.result(old.task))) == ["stale"]
    assert worker.beat(new) == ()
    assert worker.report((new, worker.result(new.task))) == ["accepted"]


def test_a_lease_expires_when_its_time_is_over_and_not_before(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context, gamma=(1.0,), phi1=(1.0,))
    (lease,) = worker.lease(simulate=1)
    clock.advance(context.settings.lease_seconds - 0.01)
    sweep(context)
    assert row(context, lease.task_id).owner == worker.id
    worker.beat(lease)
    clock.advance(context.settings.lease_seconds - 0.01)
    sweep(context)
    assert row(context, lease.task_id).owner == worker.id
    clock.advance(0.02)
    sweep(context)
    assert row(context, lease.task_id).owner is None


def test_the_first_result_wins(context: Context, worker: PretendWorker) -> None:
    """Two reports of one lease, in one batch and in another one."""
    submit(context, gamma=(1.0,), phi1=(1.0,))
    (lease,) = worker.lease(simulate=1)
    result = worker.result(lease.task)
    assert worker.report((lease, result), (lease, failure())) == ["accepted", "duplicate"]
    assert worker.report((lease, failure())) == ["duplicate"]
    assert row(context, lease.task_id).state == TaskState.succeeded


def test_a_task_fails_with_its_last_try(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job_id = submit(context, gamma=(1.0,), phi1=(1.0,))
    for _ in range(context.settings.max_tries):
        assert show_job(context, job_id).state in (JobState.queued, JobState.running)
        (lease,) = worker.lease(simulate=1)
        worker.report((lease, failure(Reason.internal_error)))
        clock.advance(60)
        sweep(context)
    failed = row(context, lease.task_id)
    assert (failed.state, failed.tries) == (TaskState.failed, context.settings.max_tries)
    assert show_job(context, job_id).state is JobState.failed


@pytest.mark.parametrize("settings", [{"max_losses": 2}], indirect=True)
def test_a_task_is_quarantined_with_its_last_loss(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context, gamma=(1.0,), phi1=(1.0,))
    for state in (TaskState.pending, TaskState.failed):
        (lease,) = worker.lease(simulate=1)
        worker.start(lease)
        clock.advance(31)
        sweep(context)
        assert row(context, lease.task_id).state == state
    assert row(context, lease.task_id).reason == Reason.quarantined


def test_the_job_of_the_highest_priority_comes_first(
    context: Context, worker: PretendWorker
) -> None:
    submit(context, gamma=(1.0,))
    submit(context, gamma=(2.0,), priority=5)
    submit(context, gamma=(3.0,), priority=-5)
    assert gammas(worker.lease(simulate=6)) == [2.0, 2.0, 1.0, 1.0, 3.0, 3.0]


def test_jobs_of_one_priority_take_turns(context: Context, worker: PretendWorker) -> None:
    submit(context, gamma=(1.0,))
    submit(context, gamma=(2.0,))
    assert gammas(worker.lease(simulate=1)) == [1.0]
    assert gammas(worker.lease(simulate=3)) == [2.0, 1.0, 2.0]


def test_cancelling_stops_waiting_tasks_at_once_and_running_ones_with_the_heartbeat(
    context: Context, worker: PretendWorker
) -> None:
    job_id = submit(context)
    (running,) = worker.lease(simulate=1)
    worker.start(running)
    assert cancel_job(context, job_id).state is JobState.cancelling
    assert worker.lease() == ()
    assert worker.beat(running) == (running.task_id,)
    sweep(context)
    detail = show_job(context, job_id)
    assert detail.state is JobState.cancelled
    assert (detail.progress.done, detail.progress.total) == (0, 11)  # nothing has a result
    for stage in detail.progress.stages.values():
        assert stage.counts.keys() == {TaskState.cancelled}
    with context.database.read() as connection:
        seq = find_job(connection, job_id).seq
        page = PageRequest(100, None)
        states = [sample.state for sample in list_samples(connection, seq, page, None).items]
        assert states == [TaskState.cancelled] * 4
        cancelled = list_samples(connection, seq, page, TaskState.cancelled).items
        assert [sample.slot for sample in cancelled] == [0, 1, 2, 3]
        assert list_samples(connection, seq, page, TaskState.pending).items == ()


def test_a_superseded_session_gets_no_tasks_and_keeps_none(
    context: Context, worker: PretendWorker
) -> None:
    submit(context)
    (lease,) = worker.lease(simulate=1)
    PretendWorker(DirectApi(context), context.store).register()
    with pytest.raises(ConflictError):
        lease_tasks(context, LeaseRequest(worker_id=worker.id, wanted={Stage.simulate: 1}))
    assert worker.beat(lease) == (lease.task_id,)
    assert row(context, lease.task_id).state == TaskState.pending


@pytest.mark.parametrize("settings", [{"lease_limit": 2}], indirect=True)
def test_one_request_leases_no_more_than_the_limit(context: Context, worker: PretendWorker) -> None:
    submit(context)
    assert len(worker.lease(simulate=3)) == 2


def test_a_render_waits_for_its_simulation(context: Context, worker: PretendWorker) -> None:
    submit(context, gamma=(1.0,), phi1=(1.0,))
    (simulation,) = worker.lease()
    assert worker.lease() == ()
    worker.finish(simulation)
    assert [lease.task.stage for lease in worker.lease()] == [Stage.render]


def test_leases_are_renewed_at_the_start_of_a_coordinator(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    """No heartbeat can arrive while it is down."""
    submit(context, gamma=(1.0,), phi1=(1.0,))
    (lease,) = worker.lease(simulate=1)
    clock.advance(3600)
    start(context)
    sweep(context)
    assert row(context, lease.task_id).expires_at == clock.now + context.settings.lease_seconds


def test_a_sweep_takes_back_the_leases_of_silent_workers_only(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context)
    (expired,) = worker.lease(simulate=1)
    other = PretendWorker(DirectApi(context), context.store, name="other").register()
    (renewed,) = other.lease(simulate=1)
    for _ in range(2):
        clock.advance(20)
        other.beat(renewed)
        sweep(context)
    assert row(context, expired.task_id).owner is None
    assert row(context, renewed.task_id).owner == other.id


def test_a_lease_that_its_worker_does_not_know_of_is_taken_back(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    """Its answer was lost on the way."""
    submit(context)
    known, lost = worker.lease(simulate=2)
    for seconds, owner in ((20, worker.id), (20, None)):
        clock.advance(seconds)
        assert worker.beat(known) == ()
        assert row(context, lost.task_id).owner == owner
    assert row(context, lost.task_id).state == TaskState.pending
    assert row(context, known.task_id).owner == worker.id


def test_heartbeats_that_wait_are_answered_together(
    context: Context, worker: PretendWorker
) -> None:
    submit(context)
    other = PretendWorker(DirectApi(context), context.store, name="other").register()
    (renewed,), (lost,) = worker.lease(simulate=1), other.lease(simulate=1)
    other.report((lost, None))
    messages = [
        Heartbeat(
            worker_id=of,
            leases=(LeaseState(task_id=lease.task_id, token=lease.token, started=False),),
            condition=worker.condition,
        )
        for of, lease in (
            (worker.id, renewed),
            (other.id, lost),
            ("worker-nobody", renewed),
            (other.id, renewed),
        )
    ]
    left = renew_leases(context, messages)
    assert left == [None, *(list(message.leases) for message in messages[1:])]
    for message, states, drop in zip(
        messages[1:], left[1:], ((lost.task_id,), None, (renewed.task_id,)), strict=True
    ):
        assert states is not None
        if drop is None:
            with pytest.raises(UnknownWorkerError):
                reconcile_leases(context, message, states)
        else:
            assert reconcile_leases(context, message, states).drop == drop
    assert row(context, renewed.task_id).owner == worker.id


def test_calls_that_wait_are_gathered_and_fail_together() -> None:
    calls: list[list[int]] = []
    first = threading.Event()

    def call(items: list[int]) -> list[int]:
        calls.append(items)
        assert first.wait(10)
        if 2 in items:
            raise ValueError("two")
        return [10 * item for item in items]

    async def use() -> list[int | BaseException]:
        batcher = Batcher(call)
        waiting = [asyncio.create_task(batcher.add(item)) for item in (1,)]
        while not calls:
            await asyncio.sleep(0.01)
        waiting += [asyncio.create_task(batcher.add(item)) for item in (2, 3, 4)]
        await asyncio.sleep(0)
        waiting[3].cancel()
        first.set()
        results = await asyncio.gather(*waiting, return_exceptions=True)
        return [*results, await batcher.add(5)]

    earliest, two, three, four, five = asyncio.run(use())
    assert (earliest, five, calls) == (10, 50, [[1], [2, 3, 4], [5]])
    assert isinstance(two, ValueError)
    assert isinstance(three, ValueError)
    assert isinstance(four, asyncio.CancelledError)


def test_reports_and_requests_show_that_a_worker_is_alive(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context)
    first, second, third = worker.lease(simulate=3)
    for seconds, act in ((25, lambda: worker.finish(first)), (25, worker.lease)):
        clock.advance(seconds)
        act()
        sweep(context)
    assert row(context, second.task_id).owner == worker.id
    assert worker.finish(second, third) == ["accepted"] * 2


def test_a_worker_that_was_heard_in_the_future_can_be_lost(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    """The clock of an earlier process was ahead."""
    submit(context)
    (lease,) = worker.lease(simulate=1)
    worker.beat(lease)
    clock.advance(-3600)
    start(context)
    clock.advance(31)
    sweep(context)
    assert row(context, lease.task_id).owner is None


def test_a_sweep_retries_due_tasks_only(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context)
    first, second = worker.lease(simulate=2)
    worker.report((first, failure()))
    clock.advance(0.5)
    worker.report((second, failure()))
    clock.advance(0.5)
    sweep(context)
    assert row(context, first.task_id).state == TaskState.pending
    assert row(context, second.task_id).state == TaskState.soft_failed


def test_a_rejected_slot_keeps_its_labels(context: Context, worker: PretendWorker) -> None:
    submit(context, gamma=(1.0,), phi1=(1.0,))
    worker.report(*((lease, rejection()) for lease in worker.lease(simulate=1)))
    (pack,) = worker.lease(pack=1)
    assert isinstance(pack.task, PackTask)
    (slot,) = pack.task.slots
    assert slot.labels == {"gamma": 1.0, "phi0": 0.0, "phi1": 1.0}
    assert slot.rejection is not None
    assert slot.rejection.labels == slot.labels
