"""What tasks cost decides on limits and on the time left.

What ends its process again and again is quarantined.
"""

import pytest
from sqlalchemy import select
from stickslip_schemas.base import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.tasks import TaskResult
from stickslip_schemas.documents.worker_api import Heartbeat, Lease, LeaseRequest, LeaseState
from stickslip_services.database.tables import cost_groups
from stickslip_services.errors import ConflictError
from stickslip_services.queue.background import sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, prioritise_job
from stickslip_services.queue.eta import (
    KEPT_RUNS,
    MEASURED,
    TIMES,
    Cost,
    StageTimings,
    limit_seconds,
    read_costs,
)
from stickslip_services.queue.lease import lease_tasks
from stickslip_services.queue.submit import submit_job
from stickslip_testing.invariants import violations
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.worker import PretendWorker, failure, heartbeat, rejection

pytestmark = pytest.mark.databases(slow=True)

FLOOR = 60.0


def submit(context: Context, *, priority: int = 0, **spec: object) -> str:
    return submit_job(context, parsed(rods(**spec)), None, priority=priority).id  # type: ignore[union-attr]


def check(context: Context) -> None:
    with context.database.read() as connection:
        assert violations(connection) == []


def finish(
    worker: PretendWorker, lease: Lease, seconds: float, *, call: float | None = None
) -> None:
    """Report a result that took so long; `call`: the whole call, the same unless told otherwise."""
    took = {"wall_seconds": seconds, "call_seconds": seconds if call is None else call}
    worker.report((lease, worker.result(lease.task).model_copy(update=took)))


# --- limits
# ------------------------------------------------------------------------------------------


def timings(*durations: float) -> StageTimings:
    return StageTimings(len(durations), sum(durations), sum(duration**2 for duration in durations))


def test_a_limit_is_three_times_what_is_expected_and_doubles_with_each_try() -> None:
    even = Cost(timings(100.0, 100.0, 100.0), timings(100.0, 100.0, 100.0))
    assert [limit_seconds(even, tries, floor=FLOOR) for tries in range(3)] == [300.0, 600.0, 1200.0]
    uneven = Cost(timings(1.0, 1.0, 1.0), timings(100.0, 200.0, 300.0))  # standard deviation 100
    assert limit_seconds(uneven, 0, floor=FLOOR) == pytest.approx(TIMES * (200.0 + 2 * 100.0))
    short = Cost(timings(0.1, 0.1, 0.1), timings(0.1, 0.1, 0.1))
    assert limit_seconds(short, 0, floor=FLOOR) == FLOOR
    assert limit_seconds(None, 0, floor=FLOOR) is None
    few = Cost(timings(1.0, 1.0), timings(1.0, 1.0))
    assert few.share.count < MEASURED
    assert limit_seconds(few, 0, floor=FLOOR) is None
    long = Cost(timings(1000.0), timings(1000.0))  # one is enough where each takes minutes
    assert limit_seconds(long, 0, floor=FLOOR) == 3000.0


def test_leases_carry_the_limit_of_their_group(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    submit(context, gamma=(1.0, 2.0, 3.0, 4.0), quality="draft")
    simulations = worker.lease(simulate=8)
    assert {lease.limit_seconds for lease in simulations} == {None}
    for lease in simulations:
        finish(worker, lease, 1.0)
    measured = worker.lease(render=4)
    for lease in measured:
        finish(worker, lease, 36.0, call=40.0)
    (lease,) = worker.lease(render=1)
    assert lease.limit_seconds == pytest.approx(120.0)
    worker.report((lease, failure(Reason.exec_timeout)))
    clock.advance(2)
    sweep(context)
    again = {lease.task_id: lease for lease in worker.lease(render=10)}[lease.task_id]
    assert again.limit_seconds == pytest.approx(240.0)
    submit(context, gamma=(1.0,), quality="high")  # another group: nothing is known of it
    assert {lease.limit_seconds for lease in worker.lease(render=10)} == {None}


def test_a_call_that_is_not_to_be_gone_by_is_not_counted(
    context: Context, worker: PretendWorker
) -> None:
    submit(context)
    (lease,) = worker.lease(simulate=1)
    worker.report((lease, worker.result(lease.task).model_copy(update={"call_seconds": None})))
    with context.database.read() as connection:
        assert connection.execute(select(cost_groups)).all() == []


def test_a_call_of_many_tasks_is_one_measurement(context: Context, worker: PretendWorker) -> None:
    """The first batch of a service is slow, and must not stand for thousands of tasks."""
    submit(context, gamma=(1.0, 2.0, 3.0, 4.0))
    for lease in worker.lease(simulate=4):
        finish(worker, lease, 0.4, call=1.6)  # four tasks of one call
    with context.database.read() as connection:
        (cost,) = (c for (stage, *_), c in read_costs(connection).items() if stage == "simulate")
    assert cost.calls == pytest.approx(1.0)
    assert not cost.is_known


def test_quick_rejections_do_not_shorten_the_time_left(
    context: Context, worker: PretendWorker
) -> None:
    """Pictures out of frame are found in milliseconds: after three of them nothing is known of the
    others.
    """
    job = submit(context, gamma=tuple(1.0 + value for value in range(12)), phi1=(1.0,))
    for lease in worker.lease(simulate=12):
        finish(worker, lease, 0.1)
    *quick, first, two, three = worker.lease(render=6)
    out = rejection().model_copy(update={"wall_seconds": 0.005, "call_seconds": 0.005})
    worker.report(*((lease, out) for lease in quick))
    assert show_job(context, job).progress.eta is None
    for lease in (first, two, three):
        finish(worker, lease, 100.0)
    eta = show_job(context, job).progress.eta
    assert eta is not None
    assert eta.low < 6 * 100.0 / worker.slots < eta.high


def test_what_was_measured_long_ago_fades(context: Context, worker: PretendWorker) -> None:
    submit(
        context, gamma=tuple(float(value) for value in range(1, 200)), phi1=(1.0, 2.0), views=None
    )
    for lease in worker.lease(simulate=KEPT_RUNS + 1):
        finish(worker, lease, 10.0)
    with context.database.read() as connection:
        before = connection.execute(select(cost_groups.c["count"], cost_groups.c.wall_sum)).one()
    assert tuple(before) == (KEPT_RUNS + 1, 10.0 * (KEPT_RUNS + 1))
    (lease,) = worker.lease(simulate=1)
    finish(worker, lease, 1.0)
    with context.database.read() as connection:
        after = connection.execute(select(cost_groups.c["count"], cost_groups.c.wall_sum)).one()
    assert tuple(after) == ((KEPT_RUNS + 1) // 2 + 1, 10.0 * (KEPT_RUNS + 1) / 2 + 1.0)


# --- quarantine
# ------------------------------------------------------------------------------------------


def poison_of(worker: PretendWorker, clock: ManualClock, context: Context, reason: Reason) -> str:
    """Let the first simulation fail three times for a reason; return its name."""
    name = ""
    for _ in range(3):
        (lease, *_) = [lease for lease in worker.lease(simulate=1) if name in ("", lease.task_id)]
        name = lease.task_id
        worker.report((lease, failure(reason, "it is gone")))
        clock.advance(10)
        sweep(context)
    return name


@pytest.mark.parametrize(
    "reason", [Reason.renderer_crash, Reason.process_crash, Reason.oom_killed, Reason.exec_timeout]
)
def test_a_task_that_ends_its_process_each_time_is_quarantined(
    context: Context, worker: PretendWorker, clock: ManualClock, reason: Reason
) -> None:
    job_id = submit(context)
    poison = poison_of(worker, clock, context, reason)
    job = show_job(context, job_id)
    assert (job.state, job.reason) == (JobState.running, Reason.quarantined)
    assert (
        f"task {poison} was quarantined after 3 tries, at last {reason}: it is gone" in job.message
    )
    assert "stickslip_workers replay" in job.message
    sweep(context)
    assert show_job(context, job_id).message == job.message  # the message stays while the job runs
    check(context)
    assert (
        worker.work() == 3 + 3 + 1
    )  # everything else: simulations, renders, and the shard that needs no poison
    assert poison not in worker.finished_ids
    sweep(context)
    job = show_job(context, job_id)
    assert (job.state, job.reason) == (JobState.failed, Reason.quarantined)
    assert "everything else is done, but 1 of its tasks were quarantined" in job.message
    assert job.progress.stages[Stage.simulate].counts[TaskState.failed] == 1
    check(context)
    again = submit(context)  # asks for it again
    worker.work()
    assert show_job(context, again).state is JobState.succeeded
    check(context)


def test_a_job_of_which_too_much_is_quarantined_fails_at_once(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    count = context.settings.max_quarantined + 1
    job_id = submit(context, gamma=tuple(1.0 + value for value in range(count + 4)), phi1=(1.0,))
    worker.judge = lambda task: failure(Reason.process_crash) if task.stage == "simulate" else None
    bad = worker.lease(simulate=count)
    for tries in range(3):
        assert show_job(context, job_id).state is JobState.running
        if tries:
            bad = tuple(
                lease
                for lease in worker.lease(simulate=100)
                if lease.task_id in {old.task_id for old in bad}
            )
        worker.finish(*bad)
        worker.register()  # the others go back
        clock.advance(10)
        sweep(context)
    job = show_job(context, job_id)
    assert (job.state, job.reason) == (JobState.failed, Reason.failed_tasks)
    assert f"{context.settings.max_quarantined + 1} of its tasks were quarantined" in job.message
    assert worker.lease() == ()
    check(context)


def test_a_job_that_shares_the_task_is_told_as_well(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    first, second = submit(context), submit(context, gamma=(1.0, 2.0, 3.0))
    poison_of(worker, clock, context, Reason.process_crash)
    assert show_job(context, first).reason is Reason.quarantined
    assert show_job(context, second).reason is Reason.quarantined
    worker.work()
    sweep(context)
    assert show_job(context, first).state is JobState.failed
    assert show_job(context, second).state is JobState.failed
    check(context)


def test_a_lost_worker_charges_no_task_until_it_is_no_accident(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    """By a heartbeat that does not come, by a new session of the name, and by a worker's own report
    of a lost node.
    """
    job_id = submit(context, gamma=(1.0,), phi1=(1.0,))
    for loss in range(context.settings.max_losses):
        assert show_job(context, job_id).state in (JobState.queued, JobState.running), loss
        (lease,) = worker.lease(simulate=1)
        worker.start(lease)
        if loss % 3 == 0:
            clock.advance(context.settings.lease_seconds + 1)
            sweep(context)
        elif loss % 3 == 1:
            worker.register()
        else:
            worker.report((lease, failure(Reason.worker_lost, "its node has died")))
    sweep(context)
    job = show_job(context, job_id)
    assert (job.state, job.reason) == (JobState.failed, Reason.quarantined)
    assert (
        f"quarantined after {context.settings.max_losses} tries, at last worker_lost" in job.message
    )
    check(context)


# --- priorities
# ------------------------------------------------------------------------------------------


def jobs_of(context: Context, leases: tuple[Lease, ...]) -> list[float]:
    return [lease.task.simulation.gamma for lease in leases]  # type: ignore[union-attr]


def test_the_highest_priority_comes_first_and_equals_share(
    context: Context, worker: PretendWorker
) -> None:
    submit(context, gamma=(1.0,), phi1=(1.0, 2.0, 3.0))
    submit(context, gamma=(2.0,), phi1=(1.0, 2.0, 3.0), priority=5)
    submit(context, gamma=(3.0,), phi1=(1.0, 2.0, 3.0), priority=5)
    assert jobs_of(context, worker.lease(simulate=4)) == [2.0, 3.0, 2.0, 3.0]
    assert jobs_of(context, worker.lease(simulate=5)) == [2.0, 3.0, 1.0, 1.0, 1.0]


def test_a_priority_can_be_changed_and_shared_tasks_go_with_the_more_urgent_job(
    context: Context, worker: PretendWorker
) -> None:
    slow = submit(context, gamma=(1.0,), phi1=(1.0, 2.0))
    submit(context, gamma=(2.0,), phi1=(1.0, 2.0), priority=1)
    urgent = submit(context, gamma=(1.0,), phi1=(1.0,), priority=9)  # shares a task with the first
    assert jobs_of(context, worker.lease(simulate=1)) == [1.0]
    assert prioritise_job(context, slow, 50).priority == 50
    assert show_job(context, slow).priority == 50
    assert jobs_of(context, worker.lease(simulate=2)) == [1.0, 2.0]
    cancel_job(context, urgent)
    check(context)


def test_an_ended_job_has_no_priority_to_change(context: Context, worker: PretendWorker) -> None:
    job = submit(context)
    cancel_job(context, job)
    with pytest.raises(ConflictError, match="its priority cannot be changed"):
        prioritise_job(context, job, 1)


def test_tasks_known_to_be_long_can_be_left_out(context: Context, worker: PretendWorker) -> None:
    submit(context, gamma=(1.0, 2.0, 3.0, 4.0), phi1=(1.0,), quality="draft")
    submit(context, gamma=(5.0,), phi1=(1.0,), quality="high")
    for lease in worker.lease(simulate=5):
        finish(worker, lease, 0.1)
    drafts = [lease for lease in worker.lease(render=5) if lease.task.render.quality == "draft"]  # type: ignore[union-attr]
    for lease in drafts[:3]:
        finish(worker, lease, 300.0)
    worker.register()

    def lease_short(at_most: float | None) -> set[str]:
        request = LeaseRequest(
            worker_id=worker.id, wanted={Stage.render: 10}, at_most_seconds=at_most
        )
        leases = lease_tasks(context, request).leases
        worker.report(*((lease, None) for lease in leases))
        return {str(lease.task.render.quality) for lease in leases}  # type: ignore[union-attr]

    assert lease_short(10.0) == {"high"}
    assert lease_short(1000.0) == {"draft", "high"}
    assert lease_short(None) == {"draft", "high"}


# --- progress and the time left
# ---------------------------------------------------------------------------------------


def test_frames_of_running_simulations_are_shown(context: Context, worker: PretendWorker) -> None:
    job_id = submit(context)
    first, second, _ = worker.lease(simulate=3)
    worker.start(first, second)

    def beat(*frames: tuple[Lease, tuple[int, int] | None]) -> None:
        states = [
            LeaseState(task_id=lease.task_id, token=lease.token, started=True, frames=shown_frames)
            for lease, shown_frames in frames
        ]
        heartbeat(
            context,
            Heartbeat(worker_id=worker.id, leases=tuple(states), condition=worker.condition),
        )

    def shown_frames() -> tuple[int, int] | None:
        return show_job(context, job_id).progress.stages[Stage.simulate].frames

    assert shown_frames() is None
    beat((first, (30, 300)), (second, (100, 300)))
    assert shown_frames() == (130, 600)
    beat((first, (60, 300)), (second, None))
    assert shown_frames() == (60, 300)
    worker.finish(first)
    assert (
        shown_frames() is None
    )  # what has ended does not count, though the worker has told nothing new
    beat((second, (100, 300)))
    worker.register().start(*worker.lease(simulate=2))
    assert shown_frames() is None  # what an earlier session has told does not count either


def test_no_time_is_told_before_enough_was_measured(
    context: Context, worker: PretendWorker
) -> None:
    job_id = submit(context, gamma=(1.0, 2.0, 3.0, 4.0, 5.0), phi1=(1.0,), views=None)
    leases = worker.lease(simulate=5)
    for done, lease in enumerate(leases[: MEASURED + 1]):
        assert (show_job(context, job_id).progress.eta is None) is (done < MEASURED)
        finish(worker, lease, 1.0)


def test_the_time_left_goes_by_groups(context: Context, worker: PretendWorker) -> None:
    """Draft pictures take 1 s and high ones 100 s: a job of high ones alone is not told the mean of
    both.
    """
    for quality, seconds in (("draft", 1.0), ("high", 100.0)):
        submit(context, gamma=(1.0, 2.0, 3.0, 4.0), phi1=(1.0,), quality=quality)
        while leases := worker.lease():
            for lease in leases:
                finish(worker, lease, seconds if lease.task.stage == "render" else 0.001)
    times = {}
    for quality in ("draft", "high"):
        job = submit(context, gamma=(11.0, 12.0, 13.0, 14.0), phi1=(1.0,), quality=quality)
        eta = show_job(context, job).progress.eta
        assert eta is not None
        times[quality] = eta.seconds
        cancel_job(context, job)
    packs = 3 * 0.001 / worker.slots
    assert times["high"] == pytest.approx(4 * 100.0 / worker.slots + packs, rel=1e-3)
    assert times["draft"] == pytest.approx(4 * 1.0 / worker.slots + packs, rel=2e-3)


def test_frames_shorten_the_time_left(context: Context, worker: PretendWorker) -> None:
    job = submit(context, gamma=(1.0, 2.0, 3.0, 4.0, 5.0), phi1=(1.0,), views=None)
    *done, last = worker.lease(simulate=5)
    for lease in done:
        finish(worker, lease, 100.0)
    worker.start(last)
    before = show_job(context, job).progress.eta
    state = LeaseState(task_id=last.task_id, token=last.token, started=True, frames=(90, 100))
    heartbeat(context, Heartbeat(worker_id=worker.id, leases=(state,), condition=worker.condition))
    after = show_job(context, job).progress.eta
    assert before is not None
    assert after is not None
    assert after.seconds < before.seconds - 40.0


def test_a_failed_result_tells_no_cost(context: Context, worker: PretendWorker) -> None:
    submit(context)
    (lease,) = worker.lease(simulate=1)
    result = TaskResult(
        outcome="failed", reason=Reason.exec_timeout, message="", wall_seconds=9.0, call_seconds=9.0
    )
    worker.report((lease, result))
    with context.database.read() as connection:
        assert connection.execute(select(cost_groups)).all() == []
