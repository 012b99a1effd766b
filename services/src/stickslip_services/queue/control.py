"""Control of jobs by users: cancel, pause, resume, prioritise, and retry a task.

Each of these is one transaction. It writes one row of `jobs`, an event and an audit entry, whatever
the number of tasks. Workers hear at their next heartbeat which tasks to drop: with a pause those
that they have not started, with a cancellation those too that they have (`heartbeat.py`).
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple, cast

from sqlalchemy import update
from stickslip_schemas.base import JobState, Reason, TaskState
from stickslip_schemas.documents.responses import JobDetail

from stickslip_services.access import audit_log
from stickslip_services.database.tables import jobs
from stickslip_services.errors import ConflictError
from stickslip_services.queue.context import Context
from stickslip_services.queue.failures import requeue
from stickslip_services.queue.job_states import set_job_state, settle_job
from stickslip_services.queue.jobs import find_job, show_job
from stickslip_services.queue.planner import plan_waiting_jobs
from stickslip_services.queue.rerun import reset_tasks
from stickslip_services.queue.rows import SCHEDULABLE, JobRow, TaskRow
from stickslip_services.queue.task_log import find_task_of_job
from stickslip_services.queue.transaction import QueueTransaction
from stickslip_services.queue.workers import NO_WORKER, update_unschedulable_jobs


def cancel_job(context: Context, job_id: str) -> JobDetail:
    """Cancel a job.

    A job that is cancelled, or being cancelled, stays so. Raises ConflictError if the job has ended
    otherwise.
    """
    with _change(context, job_id, "job.cancel") as (tx, job):
        if job.state not in (JobState.cancelling, JobState.cancelled):
            if not JobState(job.state).is_open:
                raise ConflictError(
                    f"job {job_id} has ended ({job.state}); there is nothing left to cancel"
                )
            message = "tasks that are running are being stopped"
            set_job_state(
                tx, job.seq, JobState.cancelling, reason=Reason.cancelled, message=message
            )
            # Without running tasks the job is cancelled at once, and the user sees that in the
            # answer.
            settle_job(tx, job.seq)
    return _show(context, job.seq)


def pause_job(context: Context, job_id: str) -> JobDetail:
    """Pause a job, so that no further tasks of it are leased.

    Running tasks finish. Raises ConflictError if the job has ended.
    """
    with _change(context, job_id, "job.pause") as (tx, job):
        pausing = (JobState.pausing, JobState.paused)
        if job.state not in (*SCHEDULABLE, *pausing):
            raise ConflictError(
                f"job {job_id} is {job.state}, and only one that is planning, queued or running "
                "can be paused"
            )
        # A job that waits for the store stays paused after the store works again.
        if job.state not in pausing or job.reason is not None:
            pause(tx, job.seq, message="nothing more is started; tasks that are running finish")
    return _show(context, job.seq)


def resume_job(context: Context, job_id: str) -> JobDetail:
    """Resume a paused job with the builds that it was planned for.

    A schedulable job stays as it is. Raises ConflictError if the job has ended, or while the store
    takes no results.
    """
    # The sweep would pause the job again at once.
    trouble = context.store_watch.trouble
    if trouble:
        raise ConflictError(f"{trouble}; once that is mended the job goes on by itself")
    with _change(context, job_id, "job.resume") as (tx, job):
        resume(tx, job)
    # The job may have been paused before its planning, or its workers may have gone meanwhile.
    plan_waiting_jobs(context)
    update_unschedulable_jobs(context)
    return _show(context, job.seq)


def prioritise_job(context: Context, job_id: str, priority: int) -> JobDetail:
    """Set the priority of a job.

    Raises ConflictError if the job has ended.
    """
    with _change(context, job_id, "job.prioritise", priority=priority) as (tx, job):
        if not JobState(job.state).is_open:
            raise ConflictError(
                f"job {job_id} has ended ({job.state}); its priority cannot be changed"
            )
        change = update(jobs).where(jobs.c.seq == job.seq).values(priority=priority)
        tx.connection.execute(change)
    return _show(context, job.seq)


def retry_task(context: Context, job_id: str, name: str) -> JobDetail:
    """Let a failed task of a job run again, with all its tries.

    A task that waits for its next try runs at once. Raises ConflictError if the job has ended, or
    if the task has not failed.
    """
    with _change(context, job_id, "job.retry-task", task=name) as (tx, job):
        if not JobState(job.state).is_open or job.state == JobState.cancelling:
            raise ConflictError(
                f"job {job_id} is {job.state} and starts no task; submit its spec again, which "
                "keeps all results and tries the failed tasks again"
            )
        task = find_task_of_job(tx.connection, job.seq, name)
        if task.state == TaskState.soft_failed:
            requeue(tx, [cast("TaskRow", task)])
        elif task.state == TaskState.failed:
            reset_tasks(tx, [cast("TaskRow", task).seq])
        else:
            raise ConflictError(f"task {name} is {task.state}, and only a failed one can run again")
        # A paused job keeps the reason why it rests.
        if job.state in SCHEDULABLE:
            message = f"task {name} runs again, as a user asked"
            set_job_state(tx, job.seq, JobState(job.state), message=message)
    return _show(context, job.seq)


def pause(tx: QueueTransaction, job: int, *, reason: Reason | None = None, message: str) -> None:
    """Start no further task of a job."""
    set_job_state(tx, job, JobState.pausing, reason=reason, message=message)
    settle_job(tx, job)


def resume(tx: QueueTransaction, job: JobRow) -> None:
    """Let a paused job continue.

    Raises ConflictError if the job has ended.
    """
    if job.state in SCHEDULABLE:
        return
    if job.state not in (JobState.pausing, JobState.paused):
        raise ConflictError(f"job {job.id} is {job.state}, and only a paused job can be resumed")
    # A pause keeps the job's progress in its columns. They tell which state the job returns to.
    if job.builds is None:
        reason = Reason.waiting_for_worker
        set_job_state(tx, job.seq, JobState.queued, reason=reason, message=NO_WORKER)
    elif job.planned < job.sample_count:
        set_job_state(tx, job.seq, JobState.planning)
    elif job.started_at is None:
        set_job_state(tx, job.seq, JobState.queued)
    else:
        set_job_state(tx, job.seq, JobState.running)


class _JobChange(NamedTuple):
    tx: QueueTransaction
    job: JobRow


@contextmanager
def _change(context: Context, job_id: str, action: str, **details: object) -> Iterator[_JobChange]:
    """Open a transaction that changes a job and ends with an audit entry."""
    with context.transaction() as tx:
        job = cast("JobRow", find_job(tx.connection, job_id))  # it has all columns of a JobRow
        yield _JobChange(tx, job)
        audit_log.append(tx.connection, action, job_id, tx.now, **details)


def _show(context: Context, job: int) -> JobDetail:
    with context.database.read() as connection:
        return show_job(context, connection, job)
