"""The periodic work of a coordinator.

| service | period | work |
|---|---|---|
| sweep | `sweep_seconds` | store, expiry, retries, waiting jobs, transitions of jobs |
| existing datasets | `sweep_seconds` | reads large datasets that existed before their jobs |
| scrub | `sweep_seconds` | reads datasets that nobody has read for a month, while no job runs |
| planner | `PLAN_SECONDS` | plans jobs of many samples, piece by piece |
| queue cleaner | `sweep_seconds` | removes ended jobs from the queue, piece by piece |

`access.webhooks` delivers the webhooks. Each service first asks whether there is work, in a read
transaction and by an index. So a coordinator with thousands of waiting jobs is nearly idle.
"""

import logging
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from sqlalchemy import Connection, select, text, update
from stickslip_schemas.base import JobState, Reason

from stickslip_services.access.keys import admit_local_worker
from stickslip_services.database.opening import upgrade
from stickslip_services.database.statements import RowQuery, ValueQuery
from stickslip_services.database.tables import jobs, tasks, workers
from stickslip_services.errors import DamagedRowError
from stickslip_services.queue.context import Context
from stickslip_services.queue.control import pause, resume
from stickslip_services.queue.existing_datasets import check_existing_datasets, check_small_datasets
from stickslip_services.queue.failures import expire_leases
from stickslip_services.queue.integrity import check_job
from stickslip_services.queue.job_states import end_job, has_unsettled_job, settle_jobs
from stickslip_services.queue.leaving import QueueCleaner
from stickslip_services.queue.planner import Planner, plan_waiting_jobs, release_claims
from stickslip_services.queue.rows import IS_LEASED, NEEDING_TASKS, SCHEDULABLE, JobRow, job_columns
from stickslip_services.queue.scrub import scrub_when_idle
from stickslip_services.queue.workers import update_unschedulable_jobs

logger = logging.getLogger(__name__)

PLAN_SECONDS = 0.2
"""Polling interval for jobs to plan [s]."""

CHECK_JOBS_SECONDS = 60.0
"""Interval in which a service checks the rows of all active jobs for damage [s].

Nothing else reads a job that no worker serves. The check takes 20 microseconds a job.
"""


class Service(NamedTuple):
    """A function that the coordinator calls again and again, with pauses."""

    run_once: Callable[[], object]
    seconds: float


def services(context: Context) -> list[Service]:
    """Return the services of a coordinator."""
    period = context.settings.sweep_seconds
    return [
        Service(partial(sweep, context), period),
        Service(partial(check_existing_datasets, context), period),
        Service(partial(scrub_when_idle, context), period),
        Service(Planner(context).run, PLAN_SECONDS),
        Service(QueueCleaner(context).run, period),
    ]


def start(context: Context) -> None:
    """Bring the database up to date, and resume the work of an earlier process."""
    with context.database.write() as connection:
        upgrade(connection)
        admit_local_worker(connection, context.settings.worker_key_path, context.clock())
        if context.database.is_alone(connection):
            _take_over(context, connection)
    plan_waiting_jobs(context)


def _take_over(context: Context, connection: Connection) -> None:
    """Renew leases and release claims that ran out or stayed while no coordinator was running."""
    now = context.clock()
    # Nobody answered heartbeats meanwhile, so the workers could not renew their leases.
    expires_at = now + context.settings.lease_seconds
    connection.execute(update(tasks).where(IS_LEASED).values(expires_at=expires_at))
    is_ahead = workers.c.last_seen_at > now  # by the clock of an earlier process
    # A time ahead of the clock would make a worker look alive for too long.
    connection.execute(update(workers).where(is_ahead).values(last_seen_at=now))
    # No other planner is left to hold a claim.
    release_claims(connection)


def sweep(context: Context) -> None:
    """Do all work of the sweep that is due, once."""
    fail_damaged_jobs(context)
    # The store comes before planning and leases: without it no job may start tasks.
    _watch_store(context)
    plan_waiting_jobs(context)
    expire_leases(context)
    _settle(context)
    update_unschedulable_jobs(context)
    check_small_datasets(context)


def _settle(context: Context) -> None:
    with context.database.read() as connection:
        if not has_unsettled_job(connection):
            return
    with context.transaction() as tx:
        settle_jobs(tx)


# ---- Damaged jobs --------------------------------------------------------------------------------

_ACTIVE_JOBS = RowQuery(
    JobRow,
    select(*job_columns(JobRow)).where(
        text("jobs.finished_at IS NULL"), jobs.c.state.in_([state.value for state in NEEDING_TASKS])
    ),
)


def fail_damaged_jobs(context: Context) -> None:
    """End the active jobs whose rows are damaged.

    Nobody can say which dataset such a job should make.
    """
    # Requests for tasks have found these jobs since the last sweep.
    damaged: dict[int, DamagedRowError] = context.job_builds.take_damaged()
    now = context.clock()
    if now >= context.next_job_check:
        context.next_job_check = now + CHECK_JOBS_SECONDS
        with context.database.read() as connection:
            rows = _ACTIVE_JOBS.rows(connection)
        # One damaged row must not hide the others, so each check reports by itself.
        for row in rows:
            try:
                check_job(row)
            except DamagedRowError as error:
                damaged[row.seq] = error
    if damaged:
        with context.transaction() as tx:
            for job, damage in damaged.items():
                logger.error("%s", damage)
                end_job(tx, job, JobState.failed, Reason.damaged_row, str(damage))


# ---- Store watch ---------------------------------------------------------------------------------

_IS_OPEN_AND = "FROM jobs WHERE jobs.finished_at IS NULL AND "
_IS_SCHEDULABLE = "jobs.state IN ('planning', 'queued', 'running')"
_WAITS_FOR_STORE = "jobs.state IN ('pausing', 'paused') AND jobs.reason = 'store_unavailable'"
_ANY_SCHEDULABLE_JOB: ValueQuery[int] = ValueQuery(
    f"SELECT seq {_IS_OPEN_AND} {_IS_SCHEDULABLE} LIMIT 1"
)
_ANY_WAITING_JOB: ValueQuery[int] = ValueQuery(
    f"SELECT seq {_IS_OPEN_AND} {_WAITS_FOR_STORE} LIMIT 1"
)
_SCHEDULABLE_JOBS = RowQuery(
    JobRow,
    select(*job_columns(JobRow)).where(
        text("jobs.finished_at IS NULL"), jobs.c.state.in_([s.value for s in SCHEDULABLE])
    ),
)
_JOBS_WAITING_FOR_STORE = RowQuery(
    JobRow,
    select(*job_columns(JobRow))
    .where(text(f"jobs.finished_at IS NULL AND {_WAITS_FOR_STORE}"))
    .order_by(jobs.c.seq),
)


def _watch_store(context: Context) -> None:
    """Pause jobs while the store takes no results, and resume them afterwards."""
    trouble = context.store_watch.check()
    if trouble:
        _pause_all(context, trouble)
    else:
        _resume_all(context)


def _pause_all(context: Context, trouble: str) -> None:
    with context.database.read() as connection:
        if _ANY_SCHEDULABLE_JOB.first(connection) is None:
            return
    message = (
        f"{trouble}. Nothing more is started; the job goes on by itself as soon as the store takes "
        "results again"
    )
    # The transaction reads the jobs again: one may have ended since the read above.
    with context.transaction() as tx:
        for job in _SCHEDULABLE_JOBS.rows(tx.connection):
            pause(tx, job.seq, reason=Reason.store_unavailable, message=message)
    logger.warning("jobs are paused: %s", trouble)


def _resume_all(context: Context) -> None:
    with context.database.read() as connection:
        if _ANY_WAITING_JOB.first(connection) is None:
            return
    with context.transaction() as tx:
        for job in _JOBS_WAITING_FOR_STORE.rows(tx.connection):
            resume(tx, job)
    logger.info("the store takes results again")
