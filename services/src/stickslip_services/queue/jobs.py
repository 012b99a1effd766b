"""Jobs: finding and showing them; pausing, resuming and cancelling them."""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from sqlalchemy import Connection, Row, func, insert, select, update
from stickslip_schemas.base.keys import sha256
from stickslip_schemas.base.states import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.responses import DatasetRef, Job, JobDetail, Page, Preview, SampleState
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.clock import as_datetime
from stickslip_services.database.paging import PageRequest, make_page
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import idempotency_keys, job_stages, jobs, previews, samples, tasks
from stickslip_services.errors import (
    ConflictError,
    IdempotencyKeyReusedError,
    NotFoundError,
    PreconditionFailedError,
)
from stickslip_services.queue.costs import read_costs
from stickslip_services.queue.eta import StageTimings
from stickslip_services.queue.events import set_job_state
from stickslip_services.queue.ids import task_key
from stickslip_services.queue.ledger import RUNNABLE, Ledger, charge_waiting_tasks, give_up_tasks
from stickslip_services.queue.progress import Frames, read_progress, rejected_samples
from stickslip_services.queue.workers import NO_WORKER, RegisteredWorker, count_slots


@dataclass(frozen=True, slots=True)
class Replay:
    """The answer that an idempotency key got the first time."""

    job_id: str
    response: str


def find_replay(connection: Connection, key: str, fingerprint: str) -> Replay | None:
    """Return the answer to an earlier request of this key; raise IdempotencyKeyReusedError if it asked for more."""
    row = connection.execute(
        select(idempotency_keys.c.fingerprint, idempotency_keys.c.response, jobs.c.id)
        .join(jobs, jobs.c.seq == idempotency_keys.c.job)
        .where(idempotency_keys.c.key == key)
    ).one_or_none()
    if row is None:
        return None
    if row.fingerprint != fingerprint:
        raise IdempotencyKeyReusedError(f"the Idempotency-Key {key!r} came with another document before")
    return Replay(row.id, row.response)


def keep_replay(connection: Connection, key: str, fingerprint: str, job: int, response: str, now: float) -> None:
    """Remember the answer to a request."""
    connection.execute(
        insert(idempotency_keys).values(key=key, fingerprint=fingerprint, job=job, response=response, created_at=now)
    )


def fingerprint(spec: JobSpec) -> str:
    """Return what tells one submitted document from another."""
    return sha256(spec.model_dump_json().encode())


_RUNNABLE_JOB = Prepared(select(jobs.c.seq).where(jobs.c.state.in_(RUNNABLE)).limit(1))


def has_runnable_job(connection: Connection) -> bool:
    """Tell whether there is any job to work for."""
    return _RUNNABLE_JOB.scalar(connection) is not None


def runnable_jobs(connection: Connection) -> list[str]:
    """Return the jobs that there is something to do for, oldest first."""
    return list(connection.scalars(select(jobs.c.id).where(jobs.c.state.in_(RUNNABLE)).order_by(jobs.c.seq)))


def unplanned_jobs(connection: Connection) -> Sequence[Row[Any, Any]]:
    """Return (seq, spec) of the jobs that wait for the first worker."""
    query = select(jobs.c.seq, jobs.c.spec).where(jobs.c.state.in_(RUNNABLE), jobs.c.builds.is_(None))
    return connection.execute(query.order_by(jobs.c.seq)).all()


def cancel_job(book: Ledger, job_id: str) -> int:
    """Cancel a job; a job that is being cancelled, or is, stays so. Raise ConflictError if it has ended otherwise."""
    row = find_job(book.connection, job_id)
    if row.state in (JobState.cancelling, JobState.cancelled):
        return int(row.seq)
    if not JobState(row.state).is_open:
        raise ConflictError(f"job {job_id} has ended ({row.state}); there is nothing left to cancel")
    message = "tasks that are running are being stopped"
    set_job_state(book.connection, row.seq, JobState.cancelling, book.now, reason=Reason.cancelled, message=message)
    give_up_tasks(book, row.seq)
    return int(row.seq)


def pause_job(book: Ledger, job_id: str) -> int:
    """Pause a job: nothing more is started for it, what runs finishes. Raise ConflictError if it has ended."""
    row = find_job(book.connection, job_id)
    if row.state in (JobState.pausing, JobState.paused) and row.reason is None:
        return int(row.seq)
    if row.state not in (*RUNNABLE, JobState.pausing, JobState.paused):
        raise ConflictError(
            f"job {job_id} is {row.state}, and only one that is planning, queued or running can be paused"
        )
    message = "nothing more is started; tasks that are running finish"
    set_job_state(book.connection, row.seq, JobState.pausing, book.now, message=message)
    charge_waiting_tasks(book.connection, row.seq)
    return int(row.seq)


def resume_job(book: Ledger, job_id: str) -> int:
    """Let a paused job go on; one that is not paused goes on anyway. Raise ConflictError if it has ended."""
    row = find_job(book.connection, job_id)
    if row.state in RUNNABLE:
        return int(row.seq)
    if row.state not in (JobState.pausing, JobState.paused):
        raise ConflictError(f"job {job_id} is {row.state}, and only a paused job can be resumed")
    state = JobState.queued if row.started_at is None else JobState.running
    if row.builds is not None and row.planned < row.sample_count:
        state = JobState.planning
    reason, message = (None, "") if row.builds is not None else (Reason.waiting_for_worker, NO_WORKER)
    set_job_state(book.connection, row.seq, state, book.now, reason=reason, message=message)
    charge_waiting_tasks(book.connection, row.seq)
    return int(row.seq)


def etag(job: JobDetail) -> str:
    """Return the entity tag [RFC 9110, 8.8.3] of a job as it is shown; any change changes it."""
    return f'"{sha256(job.model_dump_json().encode())[:32]}"'


def check_unchanged(job: JobDetail, etags: Collection[str]) -> None:
    """Raise PreconditionFailedError where a job's entity tag is none of `etags`."""
    if etag(job) not in etags:
        raise PreconditionFailedError(
            f"job {job.id} has changed since the ETag in If-Match, {', '.join(etags)[:200]}: get it again"
        )


def prioritise_job(book: Ledger, job_id: str, priority: int) -> int:
    """Give a job another priority. Raise ConflictError if it has ended."""
    row = find_job(book.connection, job_id)
    if not JobState(row.state).is_open:
        raise ConflictError(f"job {job_id} has ended ({row.state}); its priority cannot be changed")
    book.connection.execute(update(jobs).where(jobs.c.seq == row.seq).values(priority=priority))
    charge_waiting_tasks(book.connection, row.seq)
    return int(row.seq)


def hold_jobs(book: Ledger, trouble: str) -> None:
    """Pause the jobs that could run because the store takes no results, and let them say so."""
    message = f"{trouble}. Nothing more is started; the job goes on by itself as soon as the store takes results again"
    for seq in book.connection.scalars(select(jobs.c.seq).where(jobs.c.state.in_(RUNNABLE))).all():
        reason = Reason.store_unavailable
        set_job_state(book.connection, seq, JobState.pausing, book.now, reason=reason, message=message)
        charge_waiting_tasks(book.connection, seq)


def release_jobs(book: Ledger) -> None:
    """Let the jobs go on that waited for the store."""
    for job_id in held_jobs(book.connection):
        resume_job(book, job_id)


_HELD_JOBS = Prepared(
    select(jobs.c.id)
    .where(jobs.c.state.in_((JobState.pausing, JobState.paused)), jobs.c.reason == Reason.store_unavailable)
    .order_by(jobs.c.seq)
)


def held_jobs(connection: Connection) -> list[str]:
    """Return the jobs that wait for the store."""
    return [job_id for (job_id,) in _HELD_JOBS.tuples(connection)]


def find_job(connection: Connection, job_id: str) -> Row[tuple[object, ...]]:
    """Return the row of a job; raise NotFoundError."""
    row = connection.execute(select(jobs).where(jobs.c.id == job_id)).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no job {job_id!r}")
    return row


def traceparent_of(connection: Connection, task: str) -> str | None:
    """Return the traceparent of the job that a task is charged to; None where it has none."""
    query = select(jobs.c.traceparent).join(tasks, tasks.c.job == jobs.c.seq).where(tasks.c.key == task_key(task))
    return connection.scalar(query)


def show_job(
    connection: Connection, job: int, workers: Collection[RegisteredWorker], frames: Frames = MappingProxyType({})
) -> JobDetail:
    """Return a job with its spec."""
    row = connection.execute(select(jobs).where(jobs.c.seq == job)).one()
    return JobDetail(
        **dict(_shown(connection, [row], workers, frames)[0]), spec=job_spec_adapter.validate_json(row.spec)
    )


def list_jobs(connection: Connection, page: PageRequest, workers: Collection[RegisteredWorker]) -> Page[Job]:
    """Return a page of jobs, newest first."""
    query = select(jobs).order_by(jobs.c.seq.desc()).limit(page.size + 1)
    if page.after is not None:
        query = query.where(jobs.c.seq < page.after)
    rows = connection.execute(query).all()
    shown = dict(zip((row.seq for row in rows), _shown(connection, rows, workers, {}), strict=True))
    return make_page(rows, page, position=lambda row: int(row.seq), item=lambda row: shown[row.seq])


def list_samples(connection: Connection, job: int, page: PageRequest, state: TaskState | None) -> Page[SampleState]:
    """Return a page of the samples of a job by slot, each with the state of its last task."""
    last = func.coalesce(samples.c.render_task, samples.c.simulate_task)
    query = (
        select(
            samples.c.slot,
            samples.c.key,
            samples.c.split,
            samples.c.labels,
            tasks.c.state,
            tasks.c.reason,
            tasks.c.message,
        )
        .join(tasks, tasks.c.seq == last)
        .where(samples.c.job == job)
        .order_by(samples.c.slot)
        .limit(page.size + 1)
    )
    if page.after is not None:
        query = query.where(samples.c.slot > page.after)
    if state is not None:
        query = query.where(tasks.c.state == state)
    return make_page(
        connection.execute(query).all(),
        page,
        position=lambda row: int(row.slot),
        item=lambda row: SampleState(
            slot=row.slot,
            sample_key=row.key.hex(),
            split=row.split,
            labels=json.loads(row.labels),
            state=row.state,
            reason=row.reason,
            message=row.message,
        ),
    )


def list_previews(connection: Connection, job: int) -> list[Preview]:
    """Return the previews of a job by slot."""
    rows = connection.execute(
        select(samples.c.slot, samples.c.labels, previews.c.digest)
        .join(previews, previews.c.task == samples.c.render_task)
        .where(samples.c.job == job)
        .order_by(samples.c.slot)
        .limit(1000)
    )
    return [Preview(slot=row.slot, labels=json.loads(row.labels), href=f"/v1/previews/{row.digest}") for row in rows]


def newest_previews(connection: Connection, job: int, count: int) -> list[Preview]:
    """Return the previews of a job that came last, newest first."""
    rows = connection.execute(
        select(samples.c.slot, samples.c.labels, previews.c.digest)
        .join(previews, previews.c.task == samples.c.render_task)
        .join(tasks, tasks.c.seq == previews.c.task)
        .where(samples.c.job == job)
        .order_by(tasks.c.finished_at.desc(), samples.c.slot)
        .limit(count)
    )
    return [Preview(slot=row.slot, labels=json.loads(row.labels), href=f"/v1/previews/{row.digest}") for row in rows]


def stage_durations(connection: Connection, job: int) -> dict[Stage, StageTimings]:
    """Return the measured durations of the tasks that a job had to run, by stage."""
    rows = connection.execute(select(job_stages).where(job_stages.c.job == job))
    return {Stage(row.stage): StageTimings(row.wall_count, row.wall_sum, row.wall_squares) for row in rows}


def is_preview(connection: Connection, digest: str) -> bool:
    """Tell whether an artifact is a preview, and so for everyone to see."""
    return connection.scalar(select(previews.c.task).where(previews.c.digest == digest).limit(1)) is not None


def _shown(
    connection: Connection,
    rows: Sequence[Row[tuple[object, ...]]],
    workers: Collection[RegisteredWorker],
    frames: Frames,
) -> list[Job]:
    slots = {row.seq: count_slots(workers, row.kind, row.builds) for row in rows}
    progress = read_progress(connection, rows, slots, costs=read_costs(connection), frames=frames)
    return [
        Job(
            id=row.id,
            name=row.name,
            kind=row.kind,
            state=row.state,
            reason=row.reason,
            message=row.message,
            project=row.project,
            priority=row.priority,
            created_at=as_datetime(row.created_at),
            started_at=None if row.started_at is None else as_datetime(row.started_at),
            finished_at=None if row.finished_at is None else as_datetime(row.finished_at),
            sample_count=row.sample_count,
            rejected_count=row.rejected_count or rejected_samples(progress[row.seq]),
            progress=progress[row.seq],
            dataset=(
                None
                if row.manifest is None
                else DatasetRef(dataset=row.dataset, version=row.version, manifest=row.manifest)
            ),
        )
        for row in rows
    ]
