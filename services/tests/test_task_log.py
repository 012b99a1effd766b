"""The log of a failed task, and a failed task that runs again."""

import httpx
import pytest
from stickslip_schemas.base import JobState, Stage
from stickslip_services.errors import ConflictError, NotFoundError
from stickslip_services.queue.background import sweep
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import cancel_job, pause_job, resume_job, retry_task
from stickslip_services.queue.failures import failed_tasks
from stickslip_services.queue.jobs import find_job, lost_slots
from stickslip_services.queue.submit import submit_job
from stickslip_services.queue.task_log import TaskLog, read_task_log
from stickslip_services.units import duration, percent
from stickslip_testing.jobs import ManualClock, parsed, rods, show_job
from stickslip_testing.servers import RunningServer
from stickslip_testing.worker import PretendWorker, failure


def crash(worker: PretendWorker, clock: ManualClock, context: Context, *, attempts: int) -> None:
    """Let all simulations crash some times."""
    worker.judge = lambda task: failure(message="it broke") if task.stage == "simulate" else None
    for _ in range(attempts):
        worker.work()
        clock.advance(60)
        sweep(context)
    worker.judge = lambda _task: None


def submit(context: Context, **spec: object) -> str:
    """Submit a job of one simulation and return its id."""
    job = submit_job(context, parsed(rods(gamma=(1.0,), phi1=(1.0,), **spec)), None)
    return job.id  # type: ignore[union-attr]  # without an idempotency key there is no replay


def first_task(context: Context, job: str) -> str:
    with context.database.read() as connection:
        seq = find_job(connection, job).seq
        return failed_tasks(connection, seq, context.settings, 1)[0].task_id


def log_of(context: Context, job: str, task: str) -> TaskLog:
    with context.database.read() as connection:
        return read_task_log(connection, find_job(connection, job).seq, task, context.settings)


@pytest.mark.databases
def test_a_quarantined_task_of_an_open_job_runs_again(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(context)
    crash(worker, clock, context, attempts=2)
    task = worker.finished_ids[0]
    # Paused, so that the job is still open when its only simulation is quarantined.
    leases = worker.lease(simulate=1)
    worker.start(*leases)
    pause_job(context, job)
    worker.report(*((lease, failure(message="last")) for lease in leases))
    log = log_of(context, job, task)
    assert (log.state, log.tries) == ("failed", 3)
    assert [entry.state for entry in log.entries] == ["soft_failed", "soft_failed", "failed"]
    assert "last" in log.entries[-1].message
    assert show_job(context, job).progress.stages[Stage.simulate].counts == {"failed": 1}

    retry_task(context, job, task)
    assert show_job(context, job).state in (JobState.pausing, JobState.paused)
    assert show_job(context, job).progress.stages[Stage.simulate].counts == {"pending": 1}
    with pytest.raises(ConflictError, match="only a failed one"):
        retry_task(context, job, task)
    resume_job(context, job)
    worker.work()
    ended = show_job(context, job)
    assert ended.state is JobState.succeeded
    assert ended.progress.done == ended.progress.total


def test_a_task_that_waits_for_its_next_try_runs_at_once(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(context)
    worker.judge = lambda _task: failure()
    worker.finish(*worker.lease(simulate=1))
    worker.judge = lambda _task: None
    assert worker.work() == 0
    retry_task(context, job, first_task(context, job))
    worker.work()
    assert show_job(context, job).state is JobState.succeeded


def test_a_task_of_an_ended_job_cannot_run_again(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(context)
    crash(worker, clock, context, attempts=3)
    task = first_task(context, job)
    assert show_job(context, job).state is JobState.failed
    with pytest.raises(ConflictError, match="submit its spec again"):
        retry_task(context, job, task)
    other = submit(context, name="other", seed=7)
    with pytest.raises(NotFoundError, match="the job has no task"):
        retry_task(context, other, f"render{task.removeprefix('simulate')}")
    cancel_job(context, other)


def test_the_page_of_a_failed_task_shows_its_log(server: RunningServer) -> None:
    worker = server.worker(whole=True, judge=lambda _task: failure(message="<b>broke</b>"))
    job = httpx.post(f"{server.url}/v1/jobs", json=rods(gamma=(1.0,), phi1=(1.0,))).json()["id"]
    worker.finish(*worker.lease(simulate=1))
    page = httpx.get(f"{server.url}/jobs/{job}").text
    task = page.partition(f"/jobs/{job}/tasks/")[2].partition('"')[0]
    assert "Run again" in page
    log = httpx.get(f"{server.url}/jobs/{job}/tasks/{task}").text
    assert "&lt;b&gt;broke&lt;/b&gt;" in log
    assert "python -m stickslip_workers replay" in log
    retried = httpx.post(f"{server.url}/ui/jobs/{job}/tasks/{task}/retry")
    assert (retried.status_code, retried.headers["hx-redirect"]) == (
        204,
        f"/jobs/{job}/tasks/{task}",
    )
    assert httpx.post(f"{server.url}/v1/jobs/{job}/tasks/{task}:retry").status_code == 409
    assert httpx.get(f"{server.url}/jobs/{job}/tasks/nothing").status_code == 404


def test_a_sample_of_a_failed_simulation_counts_as_lost(
    context: Context, worker: PretendWorker, clock: ManualClock
) -> None:
    job = submit(context)
    crash(worker, clock, context, attempts=3)
    with context.database.read() as connection:
        assert lost_slots(connection, int(find_job(connection, job).seq)) == [0]


@pytest.mark.parametrize(
    ("part", "whole", "text"),
    [
        (0, 5, "0 %"),
        (1, 10**6, "0.1 %"),
        (1999, 2000, "99.9 %"),
        (999_999, 10**6, "99.9 %"),
        (5, 5, "100 %"),
        (1, 3, "33.3 %"),
        (0, 0, "0 %"),
    ],
)
def test_only_all_is_one_hundred_percent(part: int, whole: int, text: str) -> None:
    assert percent(part, whole) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 s"),
        (1e-9, "0.1 ms"),
        (0.004, "4 ms"),
        (0.0996, "100 ms"),
        (0.1, "0.1 s"),
        (59.6, "60 s"),
        (7800.0, "2 h 10 min"),
    ],
)
def test_only_nothing_takes_no_time(seconds: float, text: str) -> None:
    assert duration(seconds) == text
