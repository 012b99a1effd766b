"""Jobs: submitting, planning, showing and cancelling them."""

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Row, func, insert, select, update
from stickslip_schemas.builds import Builds
from stickslip_schemas.jobs import job_spec_adapter
from stickslip_schemas.keys import sha256
from stickslip_schemas.responses import DatasetRef, Job, JobDetail, Page, Preview, SampleState
from stickslip_schemas.states import JobState, Reason, TaskState

from stickslip_services import events
from stickslip_services.clock import as_datetime
from stickslip_services.datasets import give_dataset
from stickslip_services.errors import ConflictError, IdempotencyKeyReusedError, KindNotAvailableError, NotFoundError
from stickslip_services.ids import new_id
from stickslip_services.ledger import LIVE, Ledger, give_up_tasks, set_job_state
from stickslip_services.paging import PageRequest, make_page
from stickslip_services.planning import Plan, Spec, insert_plan
from stickslip_services.progress import read_progress, rejected_samples
from stickslip_services.tables import idempotency_keys, job_counts, jobs, previews, samples, tasks
from stickslip_services.workers import Worker, present_workers

NO_WORKER = "no worker has registered yet; the job is planned when one does"


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


def fingerprint(spec: Spec) -> str:
    """Return what tells one submitted document from another."""
    return sha256(spec.model_dump_json().encode())


def builds_for(connection: Connection, kind: str) -> Builds | None:
    """Return the builds that a new job of `kind` is planned for: those of the newest worker that makes the kind.

    None where no worker has ever registered; raise KindNotAvailableError where none of those makes it.
    """
    workers = present_workers(connection)
    if not workers:
        return None
    for worker in workers:
        if kind in worker.kinds:
            return worker.builds
    kinds = ", ".join(sorted({kind for worker in workers for kind in worker.kinds}))
    raise KindNotAvailableError(f"no worker makes {kind!r}; those that have registered make {kinds}")


def insert_job(connection: Connection, spec: Spec, plan: Plan | None, now: float) -> int:
    """Write a job down, and its tasks if it can be planned already; return its `seq`."""
    result = connection.execute(
        insert(jobs).values(
            id=new_id("job"),
            name=spec.name,
            kind=spec.kind,
            spec=spec.model_dump_json(),
            sample_count=spec.sample_count,
            state=JobState.queued,
            reason=None if plan else Reason.waiting_for_worker,
            message="" if plan else NO_WORKER,
            rejected_count=0,
            created_at=now,
        )
    )
    job = int(result.inserted_primary_key[0])  # type: ignore[index]  # of one inserted row it is never None
    reason, message = (None, "") if plan else (Reason.waiting_for_worker, NO_WORKER)
    events.append_job_state(connection, job, JobState.queued, reason, message, now)
    if plan is not None:
        plan_job(connection, job, plan, now)
    return job


def plan_job(connection: Connection, job: int, plan: Plan, now: float) -> None:
    """Write the tasks of a job; if all of it is there already, the job ends here."""
    last = insert_plan(connection, job, plan, now)
    publish_task = connection.scalar(select(tasks.c.seq).where(tasks.c.key == plan.publish_key))
    connection.execute(
        update(jobs)
        .where(jobs.c.seq == job)
        .values(builds=plan.builds.model_dump_json(), publish_task=publish_task, reason=None, message="")
    )
    if last is TaskState.succeeded and publish_task is not None:
        ending = give_dataset(connection, job, publish_task, now)
        message = ending.message or "all of it was there already"
        set_job_state(connection, job, ending.state, now, message=message)
    elif _has_started_tasks(connection, job):
        set_job_state(connection, job, JobState.running, now)


def has_live_job(connection: Connection) -> bool:
    """Tell whether there is any job to work for."""
    return connection.scalar(select(jobs.c.seq).where(jobs.c.state.in_(LIVE)).limit(1)) is not None


def unplanned_jobs(connection: Connection) -> Sequence[Row[Any, Any, Any]]:
    """Return (seq, kind, spec) of the jobs that wait for the first worker."""
    query = select(jobs.c.seq, jobs.c.kind, jobs.c.spec).where(jobs.c.state.in_(LIVE), jobs.c.builds.is_(None))
    return connection.execute(query.order_by(jobs.c.seq)).all()


def cancel_job(book: Ledger, job_id: str) -> int:
    """Cancel a job; a job that is being cancelled, or is, stays so. Raise ConflictError if it has ended otherwise."""
    row = find_job(book.connection, job_id)
    if row.state in (JobState.cancelling, JobState.cancelled):
        return int(row.seq)
    if JobState(row.state).is_terminal:
        raise ConflictError(f"job {job_id} has ended ({row.state}); there is nothing left to cancel")
    message = "tasks that are running are being stopped"
    set_job_state(book.connection, row.seq, JobState.cancelling, book.now, reason=Reason.cancelled, message=message)
    give_up_tasks(book, row.seq)
    return int(row.seq)


def find_job(connection: Connection, job_id: str) -> Row[tuple[object, ...]]:
    """Return the row of a job; raise NotFoundError."""
    row = connection.execute(select(jobs).where(jobs.c.id == job_id)).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no job {job_id!r}")
    return row


def show_job(connection: Connection, job: int, workers: Collection[Worker]) -> JobDetail:
    """Return a job with its spec."""
    row = connection.execute(select(jobs).where(jobs.c.seq == job)).one()
    return JobDetail(**dict(_shown(connection, [row], workers)[0]), spec=job_spec_adapter.validate_json(row.spec))


def list_jobs(connection: Connection, page: PageRequest, workers: Collection[Worker]) -> Page[Job]:
    """Return a page of jobs, newest first."""
    query = select(jobs).order_by(jobs.c.seq.desc()).limit(page.size + 1)
    if page.after is not None:
        query = query.where(jobs.c.seq < page.after)
    rows = connection.execute(query).all()
    shown = dict(zip((row.seq for row in rows), _shown(connection, rows, workers), strict=True))
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


def is_preview(connection: Connection, digest: str) -> bool:
    """Tell whether an artifact is a preview, and so for everyone to see."""
    return connection.scalar(select(previews.c.task).where(previews.c.digest == digest).limit(1)) is not None


def _has_started_tasks(connection: Connection, job: int) -> bool:
    query = select(func.sum(job_counts.c.count)).where(
        job_counts.c.job == job, job_counts.c.state.in_((TaskState.leased, TaskState.running))
    )
    return bool(connection.scalar(query))


def _shown(connection: Connection, rows: Sequence[Row[tuple[object, ...]]], workers: Collection[Worker]) -> list[Job]:
    progress = read_progress(connection, rows, workers)
    return [
        Job(
            id=row.id,
            name=row.name,
            kind=row.kind,
            state=row.state,
            reason=row.reason,
            message=row.message,
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
