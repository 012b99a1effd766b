"""States of jobs: how they start, pause, end and publish, with the events that tell it.

Each transition writes one row of `jobs`, whatever the number of tasks. Nobody leases tasks for a
job that is not schedulable, and workers hear at their next heartbeat which tasks to drop. Some
transitions wait for workers: `pausing` to `paused`, `cancelling` to `cancelled`, and the end of a
job of which only quarantined tasks are left. The sweep calls `settle_jobs`, which makes them.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple, Protocol

from sqlalchemy import Connection, String, bindparam, func, insert, select, text, update
from stickslip_schemas.base import Document, JobState, Reason, TaskState
from stickslip_schemas.documents.responses import (
    DatasetPublishedEvent,
    DatasetRef,
    EventName,
    JobStateEvent,
    TaskStateEvent,
)

from stickslip_services.database.statements import RowQuery, Statement, ValueQuery, batches
from stickslip_services.database.tables import events, jobs
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.rows import NEEDING_TASKS, SCHEDULABLE, TaskRow
from stickslip_services.queue.transaction import QueueTransaction

# ---- Events --------------------------------------------------------------------------------------

_APPEND_EVENT = Statement(
    insert(events).values(
        job=bindparam("b_job"),
        name=bindparam("b_name"),
        data=bindparam("b_data"),
        created_at=bindparam("b_now"),
    )
)
_OPEN_JOBS_OF_TASK: ValueQuery[int] = ValueQuery(
    "SELECT jobs.seq FROM job_tasks JOIN jobs ON jobs.seq = job_tasks.job "
    "WHERE job_tasks.task = :b_task AND jobs.finished_at IS NULL ORDER BY jobs.seq"
)


def open_jobs_of(connection: Connection, task: int) -> list[int]:
    """Return the jobs that need a task and have not ended, oldest first."""
    return _OPEN_JOBS_OF_TASK.values(connection, {"b_task": task})


def emit_task_event(
    tx: QueueTransaction, task: TaskRow, state: TaskState, reason: Reason, message: str
) -> None:
    """Store an event of a task for each of its open jobs."""
    event = TaskStateEvent(
        task_id=task_id(task.stage, task.key),
        stage=task.stage,
        state=state,
        reason=reason,
        message=message,
    )
    for job in open_jobs_of(tx.connection, task.seq):
        _append_event(tx, job, EventName.task_state, event)


def _append_event(tx: QueueTransaction, job: int, name: EventName, data: Document) -> None:
    row = {"b_job": job, "b_name": name, "b_data": data.model_dump_json(), "b_now": tx.now}
    _APPEND_EVENT.run(tx.connection, row)


# ---- Transitions ---------------------------------------------------------------------------------


# A job that goes on after a pause keeps its first start.
_SET_STATE = Statement(
    update(jobs)
    .where(jobs.c.seq == bindparam("b_job"))
    .values(
        state=bindparam("b_state"),
        reason=bindparam("b_reason"),
        message=bindparam("b_message"),
        started_at=func.coalesce(jobs.c.started_at, bindparam("b_started_at")),
        finished_at=bindparam("b_finished_at"),
        leaves_queue=bindparam("b_leaves_queue"),
    )
)


def set_job_state(
    tx: QueueTransaction,
    job: int,
    state: JobState,
    *,
    reason: Reason | None = None,
    message: str = "",
) -> None:
    """Set the state of a job with its reason and message, and store the event."""
    has_ended = not state.is_open
    values = {
        "b_job": job,
        "b_state": state,
        "b_reason": reason,
        "b_message": message,
        "b_started_at": tx.now if state is JobState.running else None,
        "b_finished_at": tx.now if has_ended else None,
        # Its rows in the queue are removed in the background: there may be a million.
        "b_leaves_queue": has_ended,
    }
    _SET_STATE.run(tx.connection, values)
    event = JobStateEvent(state=state, reason=reason, message=message)
    _append_event(tx, job, EventName.job_state, event)


class _StartedJob(NamedTuple):
    seq: int
    state: str


_JOBS_TO_START = RowQuery(
    _StartedJob,
    text(
        "SELECT DISTINCT jobs.seq, jobs.state FROM job_tasks JOIN jobs ON jobs.seq = job_tasks.job "
        "WHERE job_tasks.task IN :b_tasks AND jobs.finished_at IS NULL AND (jobs.state = 'queued' "
        "OR jobs.state = 'planning' AND jobs.started_at IS NULL)"
    ).bindparams(bindparam("b_tasks", expanding=True)),
)


def start_jobs(tx: QueueTransaction, leased_tasks: Collection[int]) -> None:
    """Make the queued jobs that need the newly leased tasks `running`."""
    for batch in batches(leased_tasks):
        for job in _JOBS_TO_START.rows(tx.connection, {"b_tasks": batch}):
            _start(tx, job)


def _start(tx: QueueTransaction, job: _StartedJob) -> None:
    if job.state == JobState.queued:
        set_job_state(tx, job.seq, JobState.running)
    else:
        # The planner is still at work, and makes the job `running` with the last piece.
        start = update(jobs).where(jobs.c.seq == job.seq).values(started_at=tx.now)
        tx.connection.execute(start)


class Version(Protocol):
    """A committed row of `dataset_versions`."""

    @property
    def dataset(self) -> str: ...
    @property
    def version(self) -> int: ...
    @property
    def manifest(self) -> str: ...
    @property
    def sample_count(self) -> int: ...
    @property
    def valid_count(self) -> int: ...


def complete_job(tx: QueueTransaction, job: int, version: Version, remark: str = "") -> None:
    """End an active job whose dataset version has been committed."""
    if not is_active(tx.connection, job):
        return
    rejected_count = version.sample_count - version.valid_count
    reference = DatasetRef(
        dataset=version.dataset, version=version.version, manifest=version.manifest
    )
    values = {**reference.model_dump(), "rejected_count": rejected_count}
    tx.connection.execute(update(jobs).where(jobs.c.seq == job).values(values))
    _append_event(tx, job, EventName.dataset_published, DatasetPublishedEvent(dataset=reference))

    sentences = [remark] if remark else []
    state = JobState.succeeded
    if rejected_count:
        state = JobState.succeeded_with_rejects
        sentences.append(
            f"{rejected_count} of {version.sample_count} samples were rejected; the dataset lists "
            "them with their reasons"
        )
    set_job_state(tx, job, state, message=". ".join(sentences))


def end_job(
    tx: QueueTransaction, job: int, state: JobState, reason: Reason | None, message: str
) -> None:
    """End a job, unless it is not active any more.

    Its tasks stay as they are, because nobody leases them without an active job.
    """
    if is_active(tx.connection, job):
        set_job_state(tx, job, state, reason=reason, message=message)


def is_active(connection: Connection, job: int) -> bool:
    """Return whether a job needs its tasks."""
    query = select(jobs.c.seq).where(jobs.c.seq == job, jobs.c.state.in_(NEEDING_TASKS))
    return connection.scalar(query) is not None


# ---- Transitions that wait for workers -----------------------------------------------------------

# Search among the tasks on lease, which are fewer than the tasks of a job.
_EXCLUSIVE_LEASE: ValueQuery[int] = ValueQuery(
    text(
        "SELECT tasks.seq FROM tasks WHERE tasks.owner IS NOT NULL "
        "AND EXISTS (SELECT 1 FROM job_tasks WHERE job_tasks.job = :b_job "
        "AND job_tasks.task = tasks.seq) "
        "AND NOT EXISTS (SELECT 1 FROM job_tasks JOIN jobs ON jobs.seq = job_tasks.job "
        "WHERE job_tasks.task = tasks.seq AND jobs.state IN :b_states) LIMIT 1"
    ).bindparams(bindparam("b_states", type_=String, expanding=True))
)


class _WaitingJob(NamedTuple):
    """A job whose transition waits for workers."""

    seq: int
    state: str
    reason: str | None
    message: str


_WAITING_JOBS = RowQuery(
    _WaitingJob,
    "SELECT seq, state, reason, message FROM jobs "
    "WHERE jobs.finished_at IS NULL AND state IN ('pausing', 'cancelling')",
)
_QUEUED_JOBS_ON_LEASE = RowQuery(
    _StartedJob,
    "SELECT DISTINCT jobs.seq, jobs.state FROM tasks CROSS JOIN job_tasks CROSS JOIN jobs "
    "WHERE tasks.owner IS NOT NULL AND job_tasks.task = tasks.seq AND jobs.seq = job_tasks.job "
    "AND jobs.state = 'queued'",
)
# A job is blocked if tasks of it have failed for good, no worker has a task of it, none waits for a
# retry, and none is ready. Then all the rest waits for a quarantined task.
_BLOCKED_JOBS: ValueQuery[int] = ValueQuery(
    "SELECT DISTINCT jobs.seq FROM job_totals CROSS JOIN jobs "
    "WHERE job_totals.failed > 0 AND jobs.seq = job_totals.job "
    "AND jobs.state IN ('queued', 'running') "
    "AND NOT EXISTS (SELECT 1 FROM ready_tasks WHERE ready_tasks.job = jobs.seq) "
    "AND NOT EXISTS (SELECT 1 FROM tasks WHERE tasks.owner IS NOT NULL AND EXISTS "
    "(SELECT 1 FROM job_tasks WHERE job_tasks.job = jobs.seq AND job_tasks.task = tasks.seq)) "
    "AND NOT EXISTS (SELECT 1 FROM tasks WHERE tasks.state = 'soft_failed' AND EXISTS "
    "(SELECT 1 FROM job_tasks WHERE job_tasks.job = jobs.seq AND job_tasks.task = tasks.seq))"
)


class _FailedTask(NamedTuple):
    seq: int
    stage: str
    key: bytes
    message: str


_FAILED_TASKS = RowQuery(
    _FailedTask,
    "SELECT tasks.seq, tasks.stage, tasks.key, tasks.message FROM job_tasks "
    "JOIN tasks ON tasks.seq = job_tasks.task "
    "WHERE job_tasks.job = :b_job AND tasks.state = 'failed' ORDER BY tasks.seq",
)


def has_exclusive_lease(connection: Connection, job: int, states: Sequence[JobState]) -> bool:
    """Return whether a job has a task on lease that no job in some states needs."""
    values = {"b_job": job, "b_states": list(states)}
    return _EXCLUSIVE_LEASE.first(connection, values) is not None


def has_unsettled_job(connection: Connection) -> bool:
    """Return whether `settle_jobs` has work, without taking the write lock."""
    return bool(
        _WAITING_JOBS.first(connection)
        or _QUEUED_JOBS_ON_LEASE.first(connection)
        or _BLOCKED_JOBS.first(connection)
    )


def settle_jobs(tx: QueueTransaction) -> None:
    """Make the transitions that waited for workers."""
    for waiting in _WAITING_JOBS.rows(tx.connection):
        _settle(tx, waiting)
    for queued in _QUEUED_JOBS_ON_LEASE.rows(tx.connection):
        _start(tx, queued)
    for blocked in _BLOCKED_JOBS.values(tx.connection):
        _end_blocked_job(tx, blocked)


def settle_job(tx: QueueTransaction, job: int) -> None:
    """End the transition of a job that was just paused or cancelled.

    It waits while a worker has a task on lease that only this job needs: a started one until it
    ends, another one until the next heartbeat returns it.
    """
    for waiting in _WAITING_JOBS.rows(tx.connection):
        if waiting.seq == job:
            _settle(tx, waiting)


def _settle(tx: QueueTransaction, job: _WaitingJob) -> None:
    if job.state == JobState.pausing:
        # A task that another schedulable job needs runs on for that job, so nobody waits for it
        # here.
        if has_exclusive_lease(tx.connection, job.seq, SCHEDULABLE):
            return
        reason = None if job.reason is None else Reason(job.reason)
        # A job that waits for the store keeps the message with the fault of the store.
        message = job.message if job.reason else "paused; resume it to go on"
        set_job_state(tx, job.seq, JobState.paused, reason=reason, message=message)
    elif not has_exclusive_lease(tx.connection, job.seq, NEEDING_TASKS):
        message = "cancelled; finished results are kept and will not be computed again"
        set_job_state(tx, job.seq, JobState.cancelled, reason=Reason.cancelled, message=message)


def _end_blocked_job(tx: QueueTransaction, job: int) -> None:
    failed = _FAILED_TASKS.rows(tx.connection, {"b_job": job})
    first = failed[0]
    message = (
        f"everything else is done, but {len(failed)} of its tasks were quarantined; the first is "
        f"{task_id(first.stage, first.key)}: {first.message}. What is done is kept; submit the job "
        "again to try again"
    )
    end_job(tx, job, JobState.failed, Reason.quarantined, message)
