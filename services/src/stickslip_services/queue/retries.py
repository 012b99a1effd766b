"""Retries: what happens to a leased task that fails, or whose worker is lost.

Losing a worker does not count as a failed try, and neither does a task that had not been started. After the n-th failed
try the task waits `retry_seconds` 2^(n-1); after `max_tries` of them it fails. A task that ended its process each time
is quarantined, and the jobs that need it continue with everything else. Any other failure ends all jobs that need the
task: they start no further tasks, and running ones finish and are kept.
"""

import shlex
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, bindparam, func, select, text
from stickslip_schemas.base import JobState, Reason, TaskState

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_counts, job_tasks, jobs, tasks
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.ledger import HELD, RUNNABLE, TASK, Ledger, reassign
from stickslip_services.settings import Settings

HELD_TASK = [*TASK, *(tasks.c[name] for name in ("key", "tries", "losses", "token", "expires_at"))]
"""Columns of a leased task, or of one whose lease has just ended."""

_FIND_HELD = Prepared(select(*HELD_TASK).where(HELD, tasks.c.owner.in_(bindparam("b_owners", expanding=True))))


def find_held(connection: Connection, owners: Sequence[str]) -> list[Any]:
    """Return the leased tasks of workers."""
    return _FIND_HELD.rows(connection, {"b_owners": owners})


def give_back(book: Ledger, held: Sequence[Any], **values: Any) -> None:
    """Return tasks to `pending`, with other values of their columns; cancel those that no live job needs."""
    book.move(reassign(book, held), TaskState.pending, **values)


def lose(book: Ledger, held: Sequence[Any], settings: Settings, *, message: str) -> None:
    """Take back the leases of a lost worker. A task fails after `max_losses` lost workers."""
    started = [task for task in held if task.state == TaskState.running]
    give_back(book, [task for task in held if task.state == TaskState.leased])
    give_back(book, [task for task in started if task.losses + 1 < settings.max_losses], losses=tasks.c.losses + 1)
    for task in started:
        if task.losses + 1 >= settings.max_losses and reassign(book, [task]):
            _fail(book, task, Reason.worker_lost, message, task.losses + 1, settings)


def fail_tries(book: Ledger, failures: Sequence[tuple[Any, Reason, str]], settings: Settings) -> None:
    """Count failed tries; each task is retried later, or fails for good."""
    for task, reason, message in failures:
        tries = task.tries + 1
        if not reassign(book, [task]):
            continue
        if tries >= settings.max_tries:
            _fail(book, task, reason, message, tries, settings)
            continue
        retry_at = book.now + settings.retry_seconds * 2 ** (tries - 1)
        why: dict[str, Any] = {"reason": reason, "message": message}
        book.move([task], TaskState.soft_failed, tries=tries, retry_at=retry_at, **why)
        book.tell(task, TaskState.soft_failed, **why)


def _fail(book: Ledger, task: Any, reason: Reason, message: str, times: int, settings: Settings) -> None:
    """Let a task fail for good after `times` failures or losses, and quarantine it or end its jobs."""
    name = task_id(task.stage, task.key)
    command = reproducer(name, settings)
    why = f"task {name} failed {times} times, at last with {reason}: {message}"
    tries = task.tries + (reason is not Reason.worker_lost)
    if is_quarantined := reason.ends_a_process:
        message = f"quarantined after {times} tries, at last {reason}: {message}. To reproduce: {command}"
        reason = Reason.quarantined
    book.move([task], TaskState.failed, tries=tries, reason=reason, message=message)
    book.tell(task, TaskState.failed, reason, message)
    book.count()
    for job in book.jobs_of(task.seq):
        state, failed = book.connection.execute(_FAILED.where(jobs.c.seq == job)).one()
        if is_quarantined and failed <= settings.max_quarantined:
            if state in RUNNABLE:
                news = f"task {name} was {message}. The job goes on with the others"
                book.set_state(job, JobState(state), reason=reason, message=news)
            continue
        if is_quarantined:
            why = f"{failed} of its tasks were quarantined, at last {name}: {message}"
        kept = "No further tasks are started; what is done is kept, and submitting the job again tries again"
        book.end(job, JobState.failed, Reason.failed_tasks, f"{why}. {kept}. To reproduce: {command}")


_FAILED = (
    select(jobs.c.state, func.sum(job_counts.c.count).filter(job_counts.c.state == TaskState.failed))
    .join(job_counts, job_counts.c.job == jobs.c.seq)
    .group_by(jobs.c.seq)
)

# A lease ends when it has had its duration, and nothing has been heard of its worker for as long.
_EXPIRED = (
    f"{HELD.text} AND tasks.expires_at <= :b_now "
    "AND tasks.owner NOT IN (SELECT workers.id FROM workers WHERE workers.last_seen_at > :b_alive_since)"
)
_DUE = "tasks.state = 'soft_failed' AND tasks.retry_at <= :b_now"
_FIND_EXPIRED, _FIND_DUE = Prepared(select(*HELD_TASK).where(text(_EXPIRED))), Prepared(select(*TASK).where(text(_DUE)))
_IS_DUE = Prepared(f"SELECT EXISTS (SELECT 1 FROM tasks WHERE {_EXPIRED}) OR EXISTS (SELECT 1 FROM tasks WHERE {_DUE})")


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
        expired = _FIND_EXPIRED.rows(book.connection, {"b_now": book.now, "b_alive_since": book.now - seconds})
        lose(book, expired, context.settings, message=f"no heartbeat for {seconds:g} s")
        book.move(_FIND_DUE.rows(book.connection, {"b_now": book.now}), TaskState.pending)


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
