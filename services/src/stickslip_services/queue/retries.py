"""Retries: what happens to a leased task that fails, or whose worker is lost.

Losing a worker does not count as a failed try, and neither does a task that had not been started. After the n-th failed
try the task waits `retry_seconds` 2^(n-1); after `max_tries` of them it fails. A task that ended its process each time
is quarantined, and the jobs that need it continue with everything else. Any other failure ends all jobs that need the
task: they start no further tasks, and running ones finish and are kept.
"""

import shlex
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, func, select, text, update
from stickslip_schemas.base.states import JobState, Reason, TaskState

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_tasks, jobs, tasks
from stickslip_services.queue.context import Context
from stickslip_services.queue.events import set_job_state
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.ledger import (
    LIVE,
    RUNNABLE,
    Ending,
    HeldTask,
    Ledger,
    Task,
    cancel_tasks,
    live_jobs,
    release,
)
from stickslip_services.settings import Settings


def find_held(book: Ledger, owners: Sequence[str]) -> list[HeldTask]:
    """Return the leased tasks of workers."""
    held = text("tasks.owner IS NOT NULL"), tasks.c.owner.in_(owners)  # in the words of the partial index
    return [HeldTask.of(row) for row in book.connection.execute(select(*HeldTask.columns()).where(*held))]


def give_back(book: Ledger, held: Sequence[HeldTask]) -> None:
    """Return tasks to `pending` as if they had never been leased; cancel those that no live job needs."""
    for task, job in _still_needed(book, held):
        release(book, task, TaskState.pending, job=job)


def lose(book: Ledger, held: Sequence[HeldTask], settings: Settings, *, message: str) -> None:
    """Take back the leases of a lost worker. A task fails after `max_losses` lost workers."""
    give_back(book, [task for task in held if task.state is TaskState.leased])
    for task, job in _still_needed(book, [task for task in held if task.state is not TaskState.leased]):
        losses = task.losses + 1
        if losses < settings.max_losses:
            release(book, task, TaskState.pending, job=job, losses=losses)
        else:
            _fail(book, task, job, Reason.worker_lost, message, losses, settings)


def fail_tries(book: Ledger, failures: Sequence[tuple[HeldTask, Reason, str]], settings: Settings) -> None:
    """Count failed tries; each task is retried later, or fails for good."""
    why = {task.seq: (reason, message) for task, reason, message in failures}
    for task, job in _still_needed(book, [task for task, _, _ in failures]):
        reason, message = why[task.seq]
        tries = task.tries + 1
        if tries >= settings.max_tries:
            _fail(book, task, job, reason, message, tries, settings)
            continue
        retry_at = book.now + settings.retry_seconds * 2 ** (tries - 1)
        values = {"tries": tries, "reason": reason, "message": message, "retry_at": retry_at}
        release(book, task, TaskState.soft_failed, job=job, **values)
        book.emit(task, TaskState.soft_failed, reason, message)


def _fail(book: Ledger, task: HeldTask, job: int, reason: Reason, message: str, times: int, settings: Settings) -> None:
    """Let a task fail for good after `times` failures or losses."""
    tries = task.tries + (reason is not Reason.worker_lost)
    values = {"job": job, "tries": tries, "finished_at": book.now}
    if not reason.ends_a_process:
        release(book, task, TaskState.failed, reason=reason, message=message, **values)
        book.emit(task, TaskState.failed, reason, message)
        _fail_jobs(book, task, f"task {task.name} failed {times} times, at last with {reason}: {message}", settings)
        return
    message = (
        f"quarantined after {times} tries, at last {reason}: {message}. To reproduce: {reproducer(task.name, settings)}"
    )
    release(book, task, TaskState.failed, reason=Reason.quarantined, message=message, **values)
    book.emit(task, TaskState.failed, Reason.quarantined, message)
    for job_seq in _live_holders(book, task):
        # The counters follow only when the ledger is closed.
        failed = select(func.count()).join(job_tasks, job_tasks.c.task == tasks.c.seq)
        failed = failed.where(job_tasks.c.job == job_seq, tasks.c.state == TaskState.failed)
        count = int(book.connection.scalar(failed) or 0)
        if count > settings.max_quarantined:
            _fail_jobs(book, task, f"{count} of its tasks were quarantined, at last {task.name}: {message}", settings)
            return
        state = JobState(book.connection.execute(select(jobs.c.state).where(jobs.c.seq == job_seq)).scalar_one())
        if state in RUNNABLE:
            news = f"task {task.name} was {message}. The job goes on with the others"
            set_job_state(book, job_seq, state, reason=Reason.quarantined, message=news)


# A lease ends when it has had its duration, and nothing has been heard of its worker for as long.
_EXPIRED = (
    "tasks.owner IS NOT NULL AND tasks.expires_at <= :b_now "  # in the words of the partial index
    "AND tasks.owner NOT IN (SELECT workers.id FROM workers WHERE workers.last_seen_at > :b_alive_since)"
)
_FIND_EXPIRED = Prepared(select(*HeldTask.columns()).where(text(_EXPIRED)))
_IS_DUE = Prepared(
    f"SELECT EXISTS (SELECT 1 FROM tasks WHERE {_EXPIRED}) "
    "OR EXISTS (SELECT 1 FROM tasks WHERE tasks.state = 'soft_failed' AND tasks.retry_at <= :b_now)"
)


def is_sweep_due(connection: Connection, now: float, alive_since: float) -> bool:
    """Return whether a lease has expired or a retry is due, without taking the write lock."""
    return bool(_IS_DUE.scalar(connection, {"b_now": now, "b_alive_since": alive_since}))


def take_back(context: Context) -> None:
    """Take back expired leases, and return tasks whose retry is due to `pending`."""
    with context.database.read() as connection:
        if not is_sweep_due(connection, context.clock(), context.alive_since):
            return
    seconds = context.settings.lease_seconds
    with context.ledger() as book:
        rows = _FIND_EXPIRED.rows(book.connection, {"b_now": book.now, "b_alive_since": book.now - seconds})
        lose(book, list(map(HeldTask.of, rows)), context.settings, message=f"no heartbeat for {seconds:g} s")
        is_due = text("tasks.state = 'soft_failed'"), tasks.c.retry_at <= book.now
        due = list(map(Task.of, book.connection.execute(select(*Task.columns()).where(*is_due))))
        book.connection.execute(update(tasks).where(*is_due).values(state=TaskState.pending, retry_at=None))
        for task in due:
            book.moved(task, TaskState.pending)


def reproducer(name: str, settings: Settings) -> str:
    """Return the shell command that runs a task alone, on a machine with a worker's environment."""
    fetch = f"curl -s {settings.url}/v1/tasks/{name} -o task.json"
    return f"{fetch} && python -m stickslip_workers replay task.json --store {shlex.quote(settings.store_place)}"


def failed_tasks(connection: Connection, job: int, settings: Settings, count: int) -> list[dict[str, Any]]:
    """Return the tasks of a job that have failed or wait for a retry, newest first, with names and reproducers."""
    rows = connection.execute(
        select(tasks.c.key, tasks.c.stage, tasks.c.tries, tasks.c.reason, tasks.c.message)
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.state.in_((TaskState.failed, TaskState.soft_failed)))
        .order_by(tasks.c.seq.desc())
        .limit(count)
    )
    return [
        {**row, "task_id": (name := task_id(row.stage, row.key)), "reproducer": reproducer(name, settings)}
        for row in rows.mappings()
    ]


def _still_needed(book: Ledger, held: Sequence[HeldTask]) -> list[tuple[HeldTask, int]]:
    """Return the tasks that a live job still needs, each with the job to charge it to; cancel the others."""
    job_of = live_jobs(book.connection, [task.seq for task in held])
    cancel_tasks(book, [task for task in held if task.seq not in job_of])
    return [(task, job_of[task.seq]) for task in held if task.seq in job_of]


def _fail_jobs(book: Ledger, task: HeldTask, message: str, settings: Settings) -> None:
    command = reproducer(task.name, settings)
    ending = Ending(
        JobState.failed,
        Reason.failed_tasks,
        f"{message}. No further tasks are started; what is done is kept, and submitting the job again tries again. "
        f"To reproduce: {command}",
    )
    for job in _live_holders(book, task):
        book.end_job(job, ending)


def _live_holders(book: Ledger, task: HeldTask) -> list[int]:
    holders = [holder.job for holder in book.holders([task.seq]).get(task.seq, ())]
    live = select(jobs.c.seq).where(jobs.c.seq.in_(holders), jobs.c.state.in_(LIVE))
    return list(book.connection.scalars(live))
