"""Jobs as they are shown: lists, details, samples, previews and events."""

import json
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import Connection, Row, func, or_, select
from stickslip_schemas.base import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.responses import (
    DatasetRef,
    EventName,
    Job,
    JobDetail,
    JobStateEvent,
    Page,
    Preview,
    SampleState,
)

from stickslip_services.access.principals import is_visible_project, is_visible_task
from stickslip_services.database.database import PageRequest, Prepared, document_of, read_page
from stickslip_services.database.tables import (
    events,
    job_stages,
    job_tasks,
    jobs,
    previews,
    samples,
    tasks,
)
from stickslip_services.errors import NotFoundError
from stickslip_services.queue.context import Context
from stickslip_services.queue.eta import Frames, StageTimings, read_progress, rejected_samples
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.recompute import check_results, check_samples, terms_of
from stickslip_services.queue.transaction import RUNNABLE
from stickslip_services.queue.workers import RegisteredWorker, alive_workers, count_slots

_UNSETTLED = [state for state in TaskState if not state.is_settled]
_RUNNABLE_JOB = Prepared(select(jobs.c.seq).where(jobs.c.state.in_(RUNNABLE)).limit(1))


def has_runnable_job(connection: Connection) -> bool:
    return _RUNNABLE_JOB.scalar(connection) is not None


def unplanned_jobs(connection: Connection) -> Sequence[Row[Any, Any]]:
    """Return the rows of the jobs that wait for the first worker."""
    query = select(jobs).where(jobs.c.state.in_(RUNNABLE), jobs.c.builds.is_(None))
    return connection.execute(query.order_by(jobs.c.seq)).all()


def find_job(connection: Connection, job_id: str) -> Row[tuple[object, ...]]:
    """Return the row of a job; raise NotFoundError."""
    row = connection.execute(
        select(jobs).where(jobs.c.id == job_id, is_visible_project(jobs.c.project))
    ).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no job {job_id!r}")
    return row


def show_job(context: Context, connection: Connection, job: int) -> JobDetail:
    """Return a job with its spec, as a transaction sees it."""
    row = connection.execute(select(jobs).where(jobs.c.seq == job)).one()
    (shown,) = _shown(connection, [row], alive_workers(context, connection), context.frames)
    detail = JobDetail(**dict(shown), spec=terms_of(row)[0])
    if (
        context.store_watch.trouble and detail.state in RUNNABLE
    ):  # the database may not be writable either
        return detail.model_copy(
            update={"reason": Reason.store_unavailable, "message": context.store_watch.trouble}
        )
    return detail


def list_jobs(
    context: Context,
    connection: Connection,
    page: PageRequest,
    search: str = "",
    state: JobState | None = None,
    project: str = "",
    *,
    newest_first: bool = True,
) -> Page[Job]:
    """Return a page of jobs: those of a state and of a project, with `search` in the name, kind, id
    or dataset.
    """
    workers = alive_workers(context, connection)
    query = select(jobs).where(is_visible_project(jobs.c.project))
    if search:
        places = (jobs.c.name, jobs.c.kind, jobs.c.id, jobs.c.dataset)
        query = query.where(or_(*(place.icontains(search, autoescape=True) for place in places)))
    query = query if state is None else query.where(jobs.c.state == state)
    query = query.where(jobs.c.project == project) if project else query
    shown = partial(_shown, connection, workers=workers, frames={})
    return read_page(connection, query, page, jobs.c.seq, shown, newest_first=newest_first)


def job_projects(connection: Connection) -> list[str]:
    query = select(jobs.c.project).where(is_visible_project(jobs.c.project)).distinct()
    return list(connection.scalars(query.order_by(jobs.c.project)))


def list_samples(
    connection: Connection, job: int, page: PageRequest, state: TaskState | None
) -> Page[SampleState]:
    """Return a page of the samples of a job by slot, each with the state of its last task."""
    last = func.coalesce(samples.c.render_task, samples.c.simulate_task)
    query = (
        select(samples, tasks.c.seq, tasks.c.state, tasks.c.reason, tasks.c.message)
        .join(tasks, tasks.c.seq == last)
        .where(samples.c.job == job)
    )
    if state is not None:
        query = query.where(tasks.c.state == state)

    def checked(rows: Sequence[Row[Any]]) -> Iterable[SampleState]:
        first = 0 if page.after is None else page.after + 1
        planned = connection.execute(select(jobs.c.planned).where(jobs.c.seq == job)).scalar_one()
        page_slots = range(first, min(first + page.size, planned))
        check_samples(rows, page_slots if state is None else [row.slot for row in rows])
        settled = [row.seq for row in rows if row.state not in _UNSETTLED]  # a damaged state, too
        check_results(connection.execute(select(tasks).where(tasks.c.seq.in_(settled))).all())
        return [
            document_of(SampleState, row, sample_key=row.key.hex(), labels=json.loads(row.labels))
            for row in rows
        ]

    return read_page(connection, query, page, samples.c.slot, checked, newest_first=False)


def list_previews(
    connection: Connection, job: int, *, count: int = 1000, newest: bool = False
) -> list[Preview]:
    """Return at most `count` previews of a job: the first ones by slot, or the newest ones, newest
    first.
    """
    query = select(samples.c.slot, samples.c.labels, previews.c.digest).where(samples.c.job == job)
    query = query.join(previews, previews.c.task == samples.c.render_task)
    if newest:
        query = query.join(tasks, tasks.c.seq == previews.c.task).order_by(
            tasks.c.finished_at.desc()
        )
    rows = connection.execute(query.order_by(samples.c.slot).limit(count))
    return [
        Preview(slot=row.slot, labels=json.loads(row.labels), href=f"/v1/previews/{row.digest}")
        for row in rows
    ]


@dataclass(frozen=True, slots=True)
class StoredEvent:
    """An event as the stream sends it; `data` is JSON."""

    id: int
    name: EventName
    data: str

    @property
    def is_last(self) -> bool:
        return (
            self.name is EventName.job_state
            and not JobStateEvent.model_validate_json(self.data).state.is_open
        )


def read_events(connection: Connection, job: int, *, after: int, limit: int) -> list[StoredEvent]:
    """Return the events of a job after the one with the id `after`."""
    query = select(events.c.id, events.c.name, events.c.data).where(
        events.c.job == job, events.c.id > after
    )
    rows = connection.execute(query.order_by(events.c.id).limit(limit))
    return [StoredEvent(row.id, EventName(row.name), row.data) for row in rows]


def stage_durations(connection: Connection, job: int) -> dict[Stage, StageTimings]:
    """Return the measured durations of the tasks that a job had to run, by stage."""
    rows = connection.execute(select(job_stages).where(job_stages.c.job == job))
    return {
        Stage(row.stage): StageTimings(row.wall_count, row.wall_sum, row.wall_squares)
        for row in rows
    }


def slowest_tasks(connection: Connection, job: int, count: int) -> list[dict[str, Any]]:
    """Return the finished tasks of a job that took longest, with names, cost groups and durations
    [s].
    """
    rows = connection.execute(
        select(
            *(
                tasks.c[name]
                for name in ("key", "stage", "cost_group", "cpu_seconds", "wall_seconds")
            )
        )
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.wall_seconds.is_not(None))
        .order_by(tasks.c.wall_seconds.desc())
        .limit(count)
    )
    return [{**row, "task_id": task_id(row.stage, row.key)} for row in rows.mappings()]


def is_preview(connection: Connection, digest: str) -> bool:
    """Return whether an artifact is a preview that the principal sees, which is served without a
    dataset.
    """
    query = select(previews.c.task).where(
        previews.c.digest == digest, is_visible_task(previews.c.task)
    )
    return connection.scalar(query.limit(1)) is not None


def _shown(
    connection: Connection,
    rows: Sequence[Row[tuple[object, ...]]],
    workers: Collection[RegisteredWorker],
    frames: Frames,
) -> list[Job]:
    served = (JobState.queued, JobState.running)
    slots = {
        row.seq: count_slots(workers, row.kind, row.builds) for row in rows if row.state in served
    }
    progress = read_progress(connection, rows, slots, frames)
    return [
        document_of(
            Job,
            row,
            rejected_count=row.rejected_count or rejected_samples(progress[row.seq]),
            progress=progress[row.seq],
            dataset=None if row.manifest is None else document_of(DatasetRef, row),
        )
        for row in rows
    ]
