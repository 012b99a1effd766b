"""Control of jobs: cancel, pause, resume and prioritise them. Each change is one transaction with an audit entry.

Only the tasks of a job that ends are given up in more transactions, since a job of a million has millions.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import Row, select, update
from stickslip_schemas.base import JobState, Reason
from stickslip_schemas.documents.responses import JobDetail

from stickslip_services.access.audit_log import note
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import jobs
from stickslip_services.errors import ConflictError
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import find_job, show_job
from stickslip_services.queue.ledger import RUNNABLE, Ledger, give_up, reassign_waiting
from stickslip_services.queue.planner import plan_waiting_jobs
from stickslip_services.queue.workers import NO_WORKER, note_stranded


def cancel_job(context: Context, job_id: str) -> JobDetail:
    """Cancel a job; one that is cancelled, or being cancelled, stays so. Raise ConflictError if it has ended."""
    with _change(context, job_id, "job.cancel") as (book, job):
        if job.state not in (JobState.cancelling, JobState.cancelled):
            if not JobState(job.state).is_open:
                raise ConflictError(f"job {job_id} has ended ({job.state}); there is nothing left to cancel")
            message = "tasks that are running are being stopped"
            book.set_state(job.seq, JobState.cancelling, reason=Reason.cancelled, message=message)
            give_up(book, job.seq)
    return _shown(context, job.seq)


_TO_GIVE_UP = Prepared(select(jobs.c.seq, jobs.c.given_up).where(jobs.c.given_up.is_not(None)).limit(1))


def give_up_waiting(context: Context) -> None:
    """Give up the remaining waiting tasks of jobs that end, piece by piece, with pauses for other writers."""
    while not context.is_closing:
        with context.database.read() as connection:
            if not _TO_GIVE_UP.tuples(connection):
                return
        began = time.monotonic()
        with context.ledger() as book:
            for job, after in _TO_GIVE_UP.tuples(book.connection):
                give_up(book, job, after)
        time.sleep(time.monotonic() - began)


def pause_job(context: Context, job_id: str) -> JobDetail:
    """Pause a job: no further tasks are leased, running ones finish. Raise ConflictError if it has ended."""
    with _change(context, job_id, "job.pause") as (book, job):
        pausing = (JobState.pausing, JobState.paused)
        if job.state not in (*RUNNABLE, *pausing):
            raise ConflictError(
                f"job {job_id} is {job.state}, and only one that is planning, queued or running can be paused"
            )
        if job.state not in pausing or job.reason is not None:  # a job that waits for the store stays paused after it
            pause(book, job.seq, message="nothing more is started; tasks that are running finish")
    return _shown(context, job.seq)


def resume_job(context: Context, job_id: str) -> JobDetail:
    """Resume a paused job with the builds that it was planned for; a job that is not paused is left as it is.

    Raises ConflictError if it has ended, or while the store takes no results.
    """
    if trouble := context.store_watch.trouble:
        raise ConflictError(f"{trouble}; once that is mended the job goes on by itself")
    with _change(context, job_id, "job.resume") as (book, job):
        resume(book, job)
    plan_waiting_jobs(context)
    note_stranded(context)
    return _shown(context, job.seq)


def prioritise_job(context: Context, job_id: str, priority: int) -> JobDetail:
    """Set the priority of a job. Raise ConflictError if it has ended."""
    with _change(context, job_id, "job.prioritise", priority=priority) as (book, job):
        if not JobState(job.state).is_open:
            raise ConflictError(f"job {job_id} has ended ({job.state}); its priority cannot be changed")
        book.connection.execute(update(jobs).where(jobs.c.seq == job.seq).values(priority=priority))
        reassign_waiting(book, job.seq)
    return _shown(context, job.seq)


@contextmanager
def _change(context: Context, job_id: str, action: str, **details: Any) -> Iterator[tuple[Ledger, Row[Any]]]:
    """Open a transaction that changes a job; yield its ledger and the job's row. It ends with an audit entry."""
    with context.ledger() as book:
        job = find_job(book.connection, job_id)
        yield book, job
        note(book.connection, action, job_id, book.now, **details)


def pause(book: Ledger, job: int, *, reason: Reason | None = None, message: str) -> None:
    """Start no further task of a job."""
    book.set_state(job, JobState.pausing, reason=reason, message=message)
    reassign_waiting(book, job)


def resume(book: Ledger, job: Any) -> None:
    """Let a job, a row of `jobs`, go on; raise ConflictError if it has ended."""
    if job.state in RUNNABLE:
        return
    if job.state not in (JobState.pausing, JobState.paused):
        raise ConflictError(f"job {job.id} is {job.state}, and only a paused job can be resumed")
    state = JobState.queued if job.started_at is None else JobState.running
    if job.builds is not None and job.planned < job.sample_count:
        state = JobState.planning
    reason, message = (None, "") if job.builds is not None else (Reason.waiting_for_worker, NO_WORKER)
    book.set_state(job.seq, state, reason=reason, message=message)
    reassign_waiting(book, job.seq)


def _shown(context: Context, job: int) -> JobDetail:
    with context.database.read() as connection:
        return show_job(context, connection, job)
