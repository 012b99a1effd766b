"""What happened to a task of a job: its numbers, and its failed attempts with their messages."""

from datetime import datetime
from typing import NamedTuple

from sqlalchemy import Connection, Row, select
from stickslip_schemas.base import TaskState
from stickslip_schemas.documents.responses import EventName, TaskStateEvent

from stickslip_services.database.database import as_datetime
from stickslip_services.database.tables import events, job_tasks, tasks
from stickslip_services.errors import NotFoundError
from stickslip_services.queue.failures import reproducer
from stickslip_services.queue.ids import task_id, task_key
from stickslip_services.settings import Settings

MAX_ENTRIES = 100
"""Newest attempts of a task that its log shows."""


class LogEntry(NamedTuple):
    """The end of an attempt, or the rejection of the sample."""

    at: datetime
    state: TaskState
    reason: str
    message: str


class TaskLog(NamedTuple):
    """A task of a job with what happened to it."""

    task_id: str
    stage: str
    state: TaskState
    reason: str | None
    message: str
    attempts: int
    """How often it was started."""
    tries: int
    """How many of these attempts failed."""
    losses: int
    """How many attempts ended with their worker."""
    started_at: datetime | None
    finished_at: datetime | None
    cpu_seconds: float | None
    wall_seconds: float | None
    reproducer: str
    entries: list[LogEntry]
    """The newest comes last."""


def find_task_of_job(connection: Connection, job: int, name: str) -> Row[tuple[object, ...]]:
    """Return the row of a task that a job needs; raise NotFoundError."""
    key = task_key(name)
    row = None
    if key is not None:
        of_job = (job_tasks.c.task == tasks.c.seq) & (job_tasks.c.job == job)
        query = select(tasks).join(job_tasks, of_job).where(tasks.c.key == key)
        row = connection.execute(query).one_or_none()
    # The same key with another stage names no task.
    if row is None or task_id(row.stage, row.key) != name:
        raise NotFoundError(f"the job has no task {name[:100]!r}")
    return row


def read_task_log(connection: Connection, job: int, name: str, settings: Settings) -> TaskLog:
    """Return what happened to a task of a job; raise NotFoundError."""
    row = find_task_of_job(connection, job, name)
    return TaskLog(
        task_id=name,
        stage=row.stage,
        state=TaskState(row.state),
        reason=row.reason,
        message=row.message,
        attempts=row.attempts,
        tries=row.tries,
        losses=row.losses,
        started_at=None if row.started_at is None else as_datetime(row.started_at),
        finished_at=None if row.finished_at is None else as_datetime(row.finished_at),
        cpu_seconds=row.cpu_seconds,
        wall_seconds=row.wall_seconds,
        reproducer=reproducer(name, settings),
        entries=_entries(connection, job, name),
    )


def _entries(connection: Connection, job: int, name: str) -> list[LogEntry]:
    """Return the events of a task, oldest first."""
    columns = events.c
    # The name of a task is so long that no message holds it by chance; the check below is exact.
    mentions = columns.data.contains(name, autoescape=True)
    query = (
        select(columns.created_at, columns.data)
        .where(columns.job == job, columns.name == EventName.task_state, mentions)
        .order_by(columns.id.desc())
        .limit(MAX_ENTRIES)
    )
    entries: list[LogEntry] = []
    for row in connection.execute(query):
        event = TaskStateEvent.model_validate_json(row.data)
        if event.task_id == name:
            at = as_datetime(row.created_at)
            entries.append(LogEntry(at, event.state, event.reason, event.message))
    return entries[::-1]
