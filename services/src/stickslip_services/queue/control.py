"""Control of jobs by users (cancel, pause, resume, prioritise), and the coordinator's own work.

Each change of a job is one transaction with an audit entry. Only the tasks of a job that ends are
given up in more transactions, since a job of a million has millions. The coordinator's own work is
done at its start, at each sweep, once a second, and while no job runs: scrubbing, which reads whole
datasets now and then, to find damaged files that are not read otherwise.
"""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from math import inf
from typing import Any

from sqlalchemy import Row, or_, select, update
from stickslip_schemas.base import JobState, Reason
from stickslip_schemas.documents.responses import JobDetail
from stickslip_schemas.format.manifest import MANIFEST_NAME, SIGNATURE_NAME, seal_text

from stickslip_services.access import audit_log
from stickslip_services.access.keys import admit_local_worker
from stickslip_services.catalog.versions import damaged_files, mend_signature
from stickslip_services.database.database import Prepared
from stickslip_services.database.opening import upgrade
from stickslip_services.database.tables import dataset_versions, jobs, tasks, workers
from stickslip_services.errors import ConflictError, DamagedRowsError
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import find_job, has_runnable_job, show_job
from stickslip_services.queue.plan import begin_planning, insert_job
from stickslip_services.queue.recompute import (
    CHECKED_AT_ONCE,
    check_made_datasets,
    fail_damaged_jobs,
    read_plan,
)
from stickslip_services.queue.report import expire_leases
from stickslip_services.queue.submit import plan_waiting_jobs, release_claims
from stickslip_services.queue.transaction import (
    IS_LEASED,
    RUNNABLE,
    QueueTransaction,
    reassign_waiting,
    release_tasks,
)
from stickslip_services.queue.workers import NO_WORKER, update_unschedulable_jobs

logger = logging.getLogger(__name__)

EVERY_SECONDS = 30 * 24 * 3600.0
"""A coordinator reads each version once in this time [s]..."""
IDLE_RATE = 50e6
"""...while no job runs, and at this rate at most [bytes/s], a third of what a hard disk reads."""


def cancel_job(context: Context, job_id: str) -> JobDetail:
    """Cancel a job; one that is cancelled, or being cancelled, stays so.

    Raise ConflictError if it has ended.
    """
    with _change(context, job_id, "job.cancel") as (tx, job):
        if job.state not in (JobState.cancelling, JobState.cancelled):
            if not JobState(job.state).is_open:
                raise ConflictError(
                    f"job {job_id} has ended ({job.state}); there is nothing left to cancel"
                )
            message = "tasks that are running are being stopped"
            tx.set_job_state(job.seq, JobState.cancelling, reason=Reason.cancelled, message=message)
            release_tasks(tx, job.seq)
    return _shown(context, job.seq)


_TO_GIVE_UP = Prepared(
    select(jobs.c.seq, jobs.c.given_up).where(jobs.c.given_up.is_not(None)).limit(1)
)


def release_ended_jobs(context: Context) -> None:
    """Give up the remaining waiting tasks of jobs that end, piece by piece, with pauses for other
    writers.
    """
    while not context.is_closing:
        with context.database.read() as connection:
            if not _TO_GIVE_UP.tuples(connection):
                return
        began = time.monotonic()
        with context.transaction() as tx:
            for job, after in _TO_GIVE_UP.tuples(tx.connection):
                release_tasks(tx, job, after)
        time.sleep(time.monotonic() - began)


def pause_job(context: Context, job_id: str) -> JobDetail:
    """Pause a job: no further tasks are leased, running ones finish.

    Raise ConflictError if it has ended.
    """
    with _change(context, job_id, "job.pause") as (tx, job):
        pausing = (JobState.pausing, JobState.paused)
        if job.state not in (*RUNNABLE, *pausing):
            raise ConflictError(
                f"job {job_id} is {job.state}, and only one that is planning, queued or running can be paused"
            )
        if (
            job.state not in pausing or job.reason is not None
        ):  # a job that waits for the store stays paused after it
            pause(tx, job.seq, message="nothing more is started; tasks that are running finish")
    return _shown(context, job.seq)


def resume_job(context: Context, job_id: str) -> JobDetail:
    """Resume a paused job with the builds that it was planned for.

    A job that is not paused is left as it is.

    Raises ConflictError if it has ended, or while the store takes no results.
    """
    if trouble := context.store_watch.trouble:
        raise ConflictError(f"{trouble}; once that is mended the job goes on by itself")
    with _change(context, job_id, "job.resume") as (tx, job):
        resume(tx, job)
    plan_waiting_jobs(context)
    update_unschedulable_jobs(context)
    return _shown(context, job.seq)


def prioritise_job(context: Context, job_id: str, priority: int) -> JobDetail:
    """Set the priority of a job. Raise ConflictError if it has ended."""
    with _change(context, job_id, "job.prioritise", priority=priority) as (tx, job):
        if not JobState(job.state).is_open:
            raise ConflictError(
                f"job {job_id} has ended ({job.state}); its priority cannot be changed"
            )
        tx.connection.execute(update(jobs).where(jobs.c.seq == job.seq).values(priority=priority))
        reassign_waiting(tx, job.seq)
    return _shown(context, job.seq)


@contextmanager
def _change(
    context: Context, job_id: str, action: str, **details: Any
) -> Iterator[tuple[QueueTransaction, Row[Any]]]:
    """Open a transaction that changes a job; yield its ledger and the job's row.

    It ends with an audit entry.
    """
    with context.transaction() as tx:
        job = find_job(tx.connection, job_id)
        yield tx, job
        audit_log.append(tx.connection, action, job_id, tx.now, **details)


def pause(tx: QueueTransaction, job: int, *, reason: Reason | None = None, message: str) -> None:
    """Start no further task of a job."""
    tx.set_job_state(job, JobState.pausing, reason=reason, message=message)
    reassign_waiting(tx, job)


def resume(tx: QueueTransaction, job: Any) -> None:
    """Let a job, a row of `jobs`, go on; raise ConflictError if it has ended."""
    if job.state in RUNNABLE:
        return
    if job.state not in (JobState.pausing, JobState.paused):
        raise ConflictError(f"job {job.id} is {job.state}, and only a paused job can be resumed")
    state = JobState.queued if job.started_at is None else JobState.running
    if job.builds is not None and job.planned < job.sample_count:
        state = JobState.planning
    reason, message = (
        (None, "") if job.builds is not None else (Reason.waiting_for_worker, NO_WORKER)
    )
    tx.set_job_state(job.seq, state, reason=reason, message=message)
    reassign_waiting(tx, job.seq)


def _shown(context: Context, job: int) -> JobDetail:
    with context.database.read() as connection:
        return show_job(context, connection, job)


def start(context: Context) -> None:
    """Bring the database up to date, and resume the work of an earlier process."""
    with context.database.write() as connection:
        upgrade(connection)
        admit_local_worker(connection, context.settings.worker_key_path, context.clock())
        if context.database.is_alone(
            connection
        ):  # no other coordinator could have taken a heartbeat
            now = context.clock()
            expires_at = now + context.settings.lease_seconds
            connection.execute(update(tasks).where(IS_LEASED).values(expires_at=expires_at))
            ahead = workers.c.last_seen_at > now  # by the clock of an earlier process
            connection.execute(update(workers).where(ahead).values(last_seen_at=now))
            release_claims(connection)
    plan_waiting_jobs(context)


def sweep(context: Context) -> None:
    """Watch the store, plan jobs that wait, take back expired leases, retry tasks, and update
    messages.
    """
    fail_damaged_jobs(context)
    _watch_store(context)
    plan_waiting_jobs(context)
    expire_leases(context)
    update_unschedulable_jobs(context)
    check_made_datasets(context, at_most=CHECKED_AT_ONCE)


_RUNNABLE_JOBS = Prepared(select(jobs).where(jobs.c.state.in_(RUNNABLE)))
_HELD_JOBS = Prepared(
    select(jobs)
    .where(
        jobs.c.state.in_((JobState.pausing, JobState.paused)),
        jobs.c.reason == Reason.store_unavailable,
    )
    .order_by(jobs.c.seq)
)


def _watch_store(context: Context) -> None:
    """Pause jobs while the store takes no results, and resume them afterwards."""
    trouble = context.store_watch.look()
    due = _RUNNABLE_JOBS if trouble else _HELD_JOBS
    with context.database.read() as connection:
        if not due.tuples(connection):
            return
    message = f"{trouble}. Nothing more is started; the job goes on by itself as soon as the store takes results again"
    with context.transaction() as tx:
        for job in due.rows(tx.connection):
            if trouble:
                pause(tx, job.seq, reason=Reason.store_unavailable, message=message)
            else:
                resume(tx, job)
    logger.warning("jobs are paused: %s", trouble) if trouble else logger.info(
        "the store takes results again"
    )


def scrub(context: Context, *, before: float, rate: float = inf) -> tuple[str, list[str]] | None:
    """Read the version that was read longest ago, at `rate` [bytes/s].

    Return its name, and paths of damaged files.

    A damaged version gets a job with the terms that it was made with, which recomputes the files
    (`recompute`). With a signing key, a version without a good signature is signed again. Returns
    None if all versions were read since `before` [s]. Raises OSError where the store is out of
    reach, ClientError if the key cannot sign.
    """
    columns = dataset_versions.c
    is_due = or_(
        columns.scrubbed_at < before, columns.scrubbed_at > context.clock()
    )  # by a clock that was ahead
    due = select(dataset_versions).where(columns.manifest.is_not(None), is_due)
    with context.database.read() as connection:
        row = connection.execute(
            due.order_by(columns.scrubbed_at, columns.publish_task).limit(1)
        ).one_or_none()
    if row is None:
        return None
    found = damaged_files(context.store, row.manifest, row.group_digest, rate=rate)
    damaged = [MANIFEST_NAME] if found is None else sorted(found)
    with context.transaction() as tx:
        own = update(dataset_versions).where(columns.publish_task == row.publish_task)
        tx.connection.execute(own.values(scrubbed_at=tx.now, damaged=len(damaged)))
        made = tx.connection.execute(
            select(jobs).where(jobs.c.publish_task == row.publish_task)
        ).all()
        if damaged and made and not any(JobState(job.state).is_open for job in made):
            with suppress(DamagedRowsError):  # then it is only named
                spec, terms = read_plan(tx.connection, made[0].seq)
                job = insert_job(tx, spec, project=made[0].project)
                begin_planning(tx, job, terms)
    key, seal = context.settings.signing_key, seal_text(row.manifest, row.group_digest)
    if (
        found is not None
        and key is not None
        and mend_signature(context.store, row.dataset, row.version, seal, key)
    ):
        damaged.append(SIGNATURE_NAME)
    return f"{row.dataset}:v{row.version}", damaged


def scrub_when_idle(context: Context) -> None:
    """Read a version that has not been read for `EVERY_SECONDS`, unless a job runs."""
    with context.database.read() as connection:
        is_busy = has_runnable_job(connection)
    if not is_busy:
        scrub(context, before=context.clock() - EVERY_SECONDS, rate=IDLE_RATE)
