"""Numbers for alerts: jobs without progress, and workers that are silent.

An alert is a rule about these numbers (`deploy/monitoring/alerts.yaml`). Here is no threshold.
"""

from typing import NamedTuple

from sqlalchemy import Connection

from stickslip_services.database.statements import RowQuery
from stickslip_services.queue.workers import present_workers

MAX_IDLE_JOBS = 20
"""Most idle jobs with a number each: the longest idle ones."""

FORGET_SECONDS = 86_400.0
"""Time after which a silent worker is presumed to be removed [s]."""


class IdleJob(NamedTuple):
    """An active job, and the time since its last progress."""

    id: str
    seconds: float


class SilentWorker(NamedTuple):
    """A worker that was not stopped, and the time since its last message."""

    name: str
    seconds: float


class _Times(NamedTuple):
    """Times of a job [s since 1970]; None: it has no result yet."""

    id: str
    created_at: float
    result_at: float | None
    event_at: float | None


# A job in the queue waits for its turn, and may do so for days. A job that waits for a worker is in
# the same state, but something is wrong. The last event is a start, a resumption or a failure.
_ACTIVE_JOBS = RowQuery(
    _Times,
    "SELECT jobs.id, jobs.created_at, "
    "(SELECT max(job_totals.updated_at) FROM job_totals WHERE job_totals.job = jobs.seq), "
    "(SELECT events.created_at FROM events WHERE events.job = jobs.seq "
    "ORDER BY events.id DESC LIMIT 1) "
    "FROM jobs WHERE jobs.finished_at IS NULL AND (jobs.state IN ('planning', 'running') "
    "OR (jobs.state = 'queued' AND jobs.reason = 'waiting_for_worker'))",
)


def idle_jobs(connection: Connection, now: float) -> list[IdleJob]:
    """Return the active jobs and the times since their last progress, the longest first.

    Progress is the result of a task, or an event of the job. `now` is in seconds since 1970.
    """
    idle: list[IdleJob] = []
    for row in _ACTIVE_JOBS.rows(connection):
        progress_at = max(row.created_at, row.result_at or 0.0, row.event_at or 0.0)
        idle.append(IdleJob(row.id, max(0.0, now - progress_at)))
    idle.sort(key=lambda job: job.seconds, reverse=True)
    return idle[:MAX_IDLE_JOBS]


def silent_workers(connection: Connection, now: float) -> list[SilentWorker]:
    """Return the workers that were not stopped, and the times since their last messages.

    A worker that has been silent for a day is left out. `now` is in seconds since 1970.
    """
    silent: list[SilentWorker] = []
    for worker in present_workers(connection, seen_since=now - FORGET_SECONDS):
        if worker.condition.state != "stopped":
            silent.append(SilentWorker(worker.name, max(0.0, now - worker.last_seen_at)))
    return silent
