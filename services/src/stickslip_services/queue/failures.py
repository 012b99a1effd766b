"""Leases that end without a result: they are returned, lost or expired, or the attempt failed.

A task counts three things. `attempts`: how often it was leased and started. `tries`: attempts that
failed; the loss of a worker is none. `losses`: workers that were lost while they ran the task. A
task that had not been started counts nothing. After the n-th failed try the task waits
`retry_seconds` 2^(n-1), and after `max_tries` failed tries it fails for good.

A task that ended its process each time is quarantined, and the jobs that need it continue with
everything else. Any other failure ends all jobs that need the task. These jobs start no further
tasks, but their running tasks finish, and the results are kept.
"""

import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from sqlalchemy import BindParameter, Connection, bindparam, select, text, update
from stickslip_schemas.base import JobState, Reason, TaskState

from stickslip_services.database.statements import RowQuery, Statement, ValueQuery, batches
from stickslip_services.database.tables import job_tasks, jobs, tasks
from stickslip_services.errors import DamagedRowError
from stickslip_services.queue.context import Context
from stickslip_services.queue.dependents import hold_dependents
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.job_states import (
    emit_task_event,
    end_job,
    open_jobs_of,
    set_job_state,
)
from stickslip_services.queue.ready import add_ready, remove_ready
from stickslip_services.queue.rows import (
    IS_LEASED,
    SCHEDULABLE,
    LeasedTask,
    Task,
    TaskRow,
    task_columns,
)
from stickslip_services.queue.totals import add_results, count_failed
from stickslip_services.queue.transaction import QueueTransaction
from stickslip_services.settings import Settings

_TASKS: BindParameter[int] = bindparam("b_tasks", expanding=True)
NO_LEASE = {"owner": None, "leased_for": None, "expires_at": None}
"""Values of a task that is not on lease."""

_REQUEUE = Statement(
    update(tasks)
    .where(tasks.c.seq.in_(_TASKS))
    .values(
        **NO_LEASE,
        state=TaskState.pending.value,
        retry_at=None,
        losses=tasks.c.losses + bindparam("b_more_losses"),
    )
)
_MARK_STARTED = Statement(
    update(tasks)
    .where(tasks.c.seq.in_(_TASKS))
    .values(
        state=TaskState.running.value,
        attempts=tasks.c.attempts + 1,
        started_at=bindparam("b_now"),
    )
)
_LEASED_TASKS = RowQuery(
    LeasedTask,
    select(*task_columns(LeasedTask)).where(
        IS_LEASED, tasks.c.owner.in_(bindparam("b_workers", expanding=True))
    ),
)


def leased_tasks_of(connection: Connection, workers: Sequence[str]) -> list[LeasedTask]:
    """Return the tasks that some workers have leased."""
    return _LEASED_TASKS.rows(connection, {"b_workers": workers})


def mark_started(tx: QueueTransaction, leased: Collection[TaskRow]) -> None:
    """Record that workers have started leased tasks.

    From then on the tasks may fail, and the loss of the worker counts.
    """
    for batch in batches(leased):
        values = {"b_tasks": [task.seq for task in batch], "b_now": tx.now}
        _MARK_STARTED.run(tx.connection, values)


# ---- Return to the queue -------------------------------------------------------------------------


def requeue(tx: QueueTransaction, leased: Collection[TaskRow], *, is_lost: bool = False) -> None:
    """Return tasks to `pending`, and to the queues of the jobs that need them."""
    for batch in batches(leased):
        seqs = [task.seq for task in batch]
        _REQUEUE.run(tx.connection, {"b_tasks": seqs, "b_more_losses": int(is_lost)})
        add_ready(tx.connection, seqs)


def requeue_lost(
    tx: QueueTransaction, leased: Sequence[LeasedTask], settings: Settings, *, message: str
) -> None:
    """End the leases that a worker has lost: it is gone, or it never received them.

    A task fails after `max_losses` workers that were lost while they ran it.
    """
    not_started: list[LeasedTask] = []
    lost: list[LeasedTask] = []
    exhausted: list[LeasedTask] = []
    for task in leased:
        # A task that was not started cannot have brought its worker down.
        if task.state != TaskState.running:
            not_started.append(task)
        elif task.losses + 1 < settings.max_losses:
            lost.append(task)
        else:
            exhausted.append(task)
    requeue(tx, not_started)
    requeue(tx, lost, is_lost=True)
    for task in exhausted:
        failure = Failure(task, Reason.worker_lost, message)
        fail_permanently(tx, failure, task.losses + 1, settings)


# A lease expires after its duration, but only if its worker has been silent for as long. Messages
# of the worker renew all its leases without a write for each of them.
_IS_EXPIRED = (
    f"{IS_LEASED.text} AND tasks.expires_at <= :b_now AND tasks.owner NOT IN "
    "(SELECT workers.id FROM workers WHERE workers.last_seen_at > :b_alive_since)"
)
_IS_RETRY_DUE = "tasks.state = 'soft_failed' AND tasks.retry_at <= :b_now"
_EXPIRED_TASKS = RowQuery(LeasedTask, select(*task_columns(LeasedTask)).where(text(_IS_EXPIRED)))
_TASKS_TO_RETRY = RowQuery(Task, select(*task_columns(Task)).where(text(_IS_RETRY_DUE)))
_IS_EXPIRY_DUE: ValueQuery[bool] = ValueQuery(
    f"SELECT EXISTS (SELECT 1 FROM tasks WHERE {_IS_EXPIRED}) "
    f"OR EXISTS (SELECT 1 FROM tasks WHERE {_IS_RETRY_DUE})"
)


def is_expiry_due(connection: Connection, now: float, alive_since: float) -> bool:
    """Return whether a lease has expired or a retry is due, without taking the write lock."""
    values = {"b_now": now, "b_alive_since": alive_since}
    return bool(_IS_EXPIRY_DUE.first(connection, values))


def expire_leases(context: Context) -> None:
    """End expired leases, and return tasks whose retry is due to `pending`."""
    # Most calls find nothing. A read does not wait for writers.
    with context.database.read() as connection:
        if not is_expiry_due(connection, context.clock(), context.alive_since):
            return
    seconds = context.settings.lease_seconds
    with context.transaction() as tx:
        values = {"b_now": tx.now, "b_alive_since": tx.now - seconds}
        expired = _EXPIRED_TASKS.rows(tx.connection, values)
        requeue_lost(tx, expired, context.settings, message=f"no heartbeat for {seconds:g} s")
        requeue(tx, _TASKS_TO_RETRY.rows(tx.connection, {"b_now": tx.now}))


# ---- Failures ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Failure:
    """A failed attempt of a task."""

    task: LeasedTask
    reason: Reason
    message: str


def record_failures(tx: QueueTransaction, failures: Sequence[Failure], settings: Settings) -> None:
    """Count failed tries, so that each task is retried later or fails for good."""
    for failure in failures:
        task = failure.task
        tries = task.tries + 1
        if tries >= settings.max_tries:
            fail_permanently(tx, failure, tries, settings)
            continue
        retry_at = tx.now + settings.retry_seconds * 2 ** (tries - 1)
        values = {"reason": failure.reason, "message": failure.message, "tries": tries}
        _set_state(tx, [task.seq], TaskState.soft_failed, retry_at=retry_at, **values)
        emit_task_event(tx, task, TaskState.soft_failed, failure.reason, failure.message)


def fail_permanently(
    tx: QueueTransaction, failure: Failure, count: int, settings: Settings
) -> None:
    """Fail a task for good after `count` failures or losses, and quarantine it or end its jobs."""
    task, reason = failure.task, failure.reason
    name = task_id(task.stage, task.key)
    command = reproducer(name, settings)
    tries = task.tries + (reason is not Reason.worker_lost)
    times = "once" if count == 1 else f"{count} times, at last"
    explanation = f"task {name} failed {times} with {reason}: {failure.message}"
    message = failure.message
    # Quarantine such a task: its jobs can go on without it, up to `max_quarantined` of them.
    if reason.ends_a_process:
        message = (
            f"quarantined after {count} tries, at last {reason}: {failure.message}. To reproduce: "
            f"{command}"
        )
        reason = Reason.quarantined
    _set_state(tx, [task.seq], TaskState.failed, tries=tries, reason=reason, message=message)
    add_results(tx.connection, [task.seq])
    emit_task_event(tx, task, TaskState.failed, reason, message)

    advice = (
        "No further tasks are started; what is done is kept, and submitting the job again tries "
        f"again. To reproduce: {command}"
    )
    # The task is shared, so its failure concerns every open job that needs it.
    for job in open_jobs_of(tx.connection, task.seq):
        if reason is not Reason.quarantined:
            end_job(tx, job, JobState.failed, Reason.failed_tasks, f"{explanation}. {advice}")
        else:
            _report_quarantine(tx, job, name, message, advice, settings)


def _report_quarantine(
    tx: QueueTransaction, job: int, name: str, message: str, advice: str, settings: Settings
) -> None:
    """Let a job continue without a quarantined task, unless it has too many of them."""
    failed_count = count_failed(tx.connection, job)
    if failed_count > settings.max_quarantined:
        explanation = f"{failed_count} of its tasks were quarantined, at last {name}: {message}"
        end_job(tx, job, JobState.failed, Reason.failed_tasks, f"{explanation}. {advice}")
        return
    state = tx.connection.scalar(select(jobs.c.state).where(jobs.c.seq == job))
    if state in SCHEDULABLE:
        news = f"task {name} was {message}. The job goes on with the others"
        set_job_state(tx, job, JobState(state), reason=Reason.quarantined, message=news)


def fail_damaged(tx: QueueTransaction, task: LeasedTask, error: DamagedRowError) -> None:
    """End the jobs that need a damaged row, which a lease of `task` has found.

    The task and the damaged results fail for good. If a later submission of a spec needs them, it
    writes them anew and computes them again (`insertion`).
    """
    message = str(error)
    discarded = [seq for seq in error.results if seq != task.seq]
    # A damaged result may belong to jobs that do not need the task itself.
    affected_jobs: set[int] = set()
    for seq in (task.seq, *discarded):
        affected_jobs.update(open_jobs_of(tx.connection, seq))
    emit_task_event(tx, task, TaskState.failed, Reason.damaged_row, message)
    _set_state(
        tx, [task.seq, *discarded], TaskState.failed, reason=Reason.damaged_row, message=message
    )
    remove_ready(tx.connection, [task.seq, *discarded])
    # Dependents in other jobs must not run with a discarded result.
    hold_dependents(tx, discarded)
    # The totals of these jobs are not corrected, because the jobs end here.
    for job in sorted(affected_jobs):
        end_job(tx, job, JobState.failed, Reason.damaged_row, message)


def fail_invalid_dataset(tx: QueueTransaction, task: LeasedTask, message: str) -> None:
    """End the jobs whose publish task has no valid sample to publish."""
    _set_state(tx, [task.seq], TaskState.failed, reason=Reason.no_valid_samples, message=message)
    add_results(tx.connection, [task.seq])
    for job in open_jobs_of(tx.connection, task.seq):
        end_job(tx, job, JobState.failed, Reason.no_valid_samples, message)


def _set_state(
    tx: QueueTransaction, seqs: Collection[int], state: TaskState, **values: object
) -> None:
    """End the leases of tasks, and put the tasks into a state."""
    values = {"retry_at": None, **NO_LEASE, **values}
    values["finished_at"] = tx.now if state.is_over else None
    change = update(tasks).where(tasks.c.seq.in_(seqs)).values(state=state, **values)
    tx.connection.execute(change)


# ---- What users see ------------------------------------------------------------------------------


def reproducer(name: str, settings: Settings) -> str:
    """Return the shell command that runs a task alone, on a machine with a worker's environment."""
    fetch = f"curl -s {settings.url}/v1/tasks/{name} -o task.json"
    store = shlex.quote(settings.store_place)
    return f"{fetch} && python -m stickslip_workers replay task.json --store {store}"


class FailedTask(NamedTuple):
    """A task that failed for good or waits for a retry."""

    task_id: str
    stage: str
    tries: int
    reason: str | None
    message: str
    reproducer: str


def failed_tasks(
    connection: Connection, job: int, settings: Settings, count: int
) -> list[FailedTask]:
    """Return the newest tasks of a job that have failed or wait for a retry."""
    rows = connection.execute(
        select(tasks.c.key, tasks.c.stage, tasks.c.tries, tasks.c.reason, tasks.c.message)
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.state.in_((TaskState.failed, TaskState.soft_failed)))
        .order_by(tasks.c.seq.desc())
        .limit(count)
    )
    failed: list[FailedTask] = []
    for row in rows:
        name = task_id(row.stage, row.key)
        failed.append(
            FailedTask(
                task_id=name,
                stage=row.stage,
                tries=row.tries,
                reason=row.reason,
                message=row.message,
                reproducer=reproducer(name, settings),
            )
        )
    return failed
