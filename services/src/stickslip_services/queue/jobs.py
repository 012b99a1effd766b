"""Jobs as the API shows them: lists, details, samples, previews and events."""

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from sqlalchemy import Connection, Row, bindparam, func, or_, select
from stickslip_schemas.base import JobState, Reason, TaskState
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
from stickslip_services.addresses import link
from stickslip_services.database.database import PageRequest, document_of, read_page
from stickslip_services.database.statements import RowQuery, ValueQuery
from stickslip_services.database.tables import events, job_tasks, jobs, previews, samples, tasks
from stickslip_services.errors import DamagedRowError, NotFoundError
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.integrity import check_results, check_samples, plan_inputs_of, spec_of
from stickslip_services.queue.progress import Frames, read_progress, rejected_samples
from stickslip_services.queue.rows import (
    FINISHED,
    SCHEDULABLE,
    SampleRow,
    TaskResultRow,
    task_columns,
)
from stickslip_services.queue.workers import RegisteredWorker, alive_workers, count_slots

MAX_JOBS_OF_VERSION = 10
"""Jobs that the page of a version names."""

_WITHOUT_RESULT = [state.value for state in TaskState if not state.is_settled]

_SCHEDULABLE_JOB: ValueQuery[int] = ValueQuery(
    "SELECT seq FROM jobs WHERE jobs.finished_at IS NULL "
    "AND state IN ('planning', 'queued', 'running') LIMIT 1"
)


_RESULTS = RowQuery(
    TaskResultRow,
    select(*task_columns(TaskResultRow)).where(
        tasks.c.seq.in_(bindparam("b_tasks", expanding=True))
    ),
)


def has_schedulable_job(connection: Connection) -> bool:
    """Return whether tasks of any job may be leased, now or later."""
    return _SCHEDULABLE_JOB.first(connection) is not None


def find_job(connection: Connection, job_id: str) -> Row[tuple[object, ...]]:
    """Return the row of a job.

    Raises NotFoundError if the principal sees no such job.
    """
    row = connection.execute(
        select(jobs).where(jobs.c.id == job_id, is_visible_project(jobs.c.project))
    ).one_or_none()
    if row is None:
        raise NotFoundError(f"there is no job {job_id!r}")
    return row


def show_job(context: Context, connection: Connection, job: int) -> JobDetail:
    """Return a job with its spec, as a transaction sees it."""
    row = _job_row(connection, job)
    slots = _slots_by_job([row], alive_workers(context, connection))
    return _detail(context, connection, row, slots, context.frames)


def show_new_job(context: Context, connection: Connection, job: int) -> JobDetail:
    """Return a job as the answer to its submission, without the time left.

    The answer is stored for repeated requests, and the workers may differ by then.
    """
    return _detail(context, connection, _job_row(connection, job), slots={}, frames={})


def _job_row(connection: Connection, job: int) -> Row[tuple[object, ...]]:
    return connection.execute(select(jobs).where(jobs.c.seq == job)).one()


def _detail(
    context: Context,
    connection: Connection,
    row: Row[tuple[object, ...]],
    slots: Mapping[int, int],
    frames: Frames,
) -> JobDetail:
    """Return a row of `jobs` as the API shows a single job."""
    spec = spec_of(row)
    (entry,) = _entries(connection, [row], slots, frames)
    # Entry and spec have been validated. Another validation would count the values of all axes
    # again, which takes longer than the queries where a list has thousands.
    detail = JobDetail.model_construct(**dict(entry), spec=spec)
    # While the store takes no results, the database may not be writable either.
    if context.store_watch.trouble and detail.state in SCHEDULABLE:
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
    """Return a page of jobs of a state and of a project.

    `search` keeps the jobs that have it in the name, kind, id or dataset.
    """
    workers = alive_workers(context, connection)
    query = select(jobs).where(is_visible_project(jobs.c.project))
    if search:
        columns = (jobs.c.name, jobs.c.kind, jobs.c.id, jobs.c.dataset)
        matches = [column.icontains(search, autoescape=True) for column in columns]
        query = query.where(or_(*matches))
    if state is not None:
        query = query.where(jobs.c.state == state)
    if project:
        query = query.where(jobs.c.project == project)

    def entries(rows: Sequence[Row[tuple[object, ...]]]) -> list[Job]:
        return _entries(connection, rows, _slots_by_job(rows, workers), frames={})

    return read_page(connection, query, page, jobs.c.seq, entries, newest_first=newest_first)


def jobs_of_version(connection: Connection, dataset: str, version: int) -> list[tuple[str, str]]:
    """Return id and name of the newest jobs that made or share a version; the name may be empty."""
    query = (
        select(jobs.c.id, func.coalesce(jobs.c.name, ""))
        .where(jobs.c.dataset == dataset, jobs.c.version == version)
        .where(is_visible_project(jobs.c.project))
        .order_by(jobs.c.seq.desc())
        .limit(MAX_JOBS_OF_VERSION)
    )
    return [(row[0], row[1]) for row in connection.execute(query)]


def job_projects(connection: Connection) -> list[str]:
    """Return the projects of the jobs that the principal sees."""
    query = select(jobs.c.project).where(is_visible_project(jobs.c.project)).distinct()
    return list(connection.scalars(query.order_by(jobs.c.project)))


def list_samples(
    connection: Connection, job: int, page: PageRequest, state: TaskState | None
) -> Page[SampleState]:
    """Return a page of the samples of a job by slot, each with the state of its last task.

    Raises DamagedRowError.
    """
    last = func.coalesce(samples.c.render_task, samples.c.simulate_task)
    query = (
        select(samples, tasks.c.seq, tasks.c.state, tasks.c.reason, tasks.c.message)
        .join(tasks, tasks.c.seq == last)
        .where(samples.c.job == job)
    )
    row = connection.execute(
        select(jobs.c.planned, jobs.c.finished_at).where(jobs.c.seq == job)
    ).one()
    shown_job = _JobOfSamples(job, row.planned, has_ended=row.finished_at is not None)
    if state is not None:
        query = query.where(tasks.c.state.in_(_stored_states(state, shown_job)))
    return read_page(
        connection,
        query,
        page,
        samples.c.slot,
        partial(_sample_states, connection, shown_job, page, state),
        newest_first=False,
    )


def lost_slots(connection: Connection, job: int) -> list[int]:
    """Return the slots of a job of which any task was rejected or failed, in order.

    The render of a failed simulation never runs, so the state of the last task alone does not tell.
    """
    is_of_sample = tasks.c.seq.in_((samples.c.simulate_task, samples.c.render_task))
    query = (
        select(samples.c.slot)
        .join(tasks, is_of_sample)
        .where(samples.c.job == job, tasks.c.state.in_((TaskState.rejected, TaskState.failed)))
        .distinct()
        .order_by(samples.c.slot)
    )
    return list(connection.scalars(query))


class _JobOfSamples(NamedTuple):
    seq: int
    planned: int
    has_ended: bool


_UNFINISHED = [state.value for state in TaskState if state not in FINISHED]
"""States of a task that a job does not get any more once it has ended.

The API shows them as `cancelled`.
"""


def _stored_states(state: TaskState, job: _JobOfSamples) -> list[str]:
    """Return the states in the database of the samples that the API shows in a state."""
    if not job.has_ended:
        return [state.value]
    if state is TaskState.cancelled:
        return _UNFINISHED
    return [] if state.value in _UNFINISHED else [state.value]


def _sample_states(
    connection: Connection,
    job: _JobOfSamples,
    page: PageRequest,
    state: TaskState | None,
    rows: Sequence[Row[tuple[object, ...]]],
) -> Iterable[SampleState]:
    """Check rows of samples with their last tasks, and return them as the API shows them."""
    sample_rows = [SampleRow(*(getattr(row, name) for name in SampleRow._fields)) for row in rows]
    if state is None:
        first = 0 if page.after is None else page.after + 1
        slots = list(range(first, min(first + page.size, job.planned)))
    else:
        slots = [row.slot for row in sample_rows]
    check_samples(sample_rows, job.seq, slots)

    # A damaged row may have an unknown state. Its result is checked too, which finds the damage.
    with_result = [row.seq for row in rows if row.state not in _WITHOUT_RESULT]
    check_results(_RESULTS.batched_rows(connection, "b_tasks", with_result))

    states: list[SampleState] = []
    for row in rows:
        labels = json.loads(row.labels)
        is_cancelled = job.has_ended and row.state in _UNFINISHED
        shown_state = TaskState.cancelled if is_cancelled else row.state
        key = row.key.hex()
        states.append(
            document_of(SampleState, row, sample_key=key, labels=labels, state=shown_state)
        )
    return states


def list_previews(
    connection: Connection, job: int, *, count: int = 1000, newest: bool = False
) -> list[Preview]:
    """Return at most `count` previews of a job: the first previews by slot, or the newest."""
    query = select(samples.c.slot, samples.c.labels, previews.c.digest).where(samples.c.job == job)
    query = query.join(previews, previews.c.task == samples.c.render_task)
    if newest:
        query = query.join(tasks, tasks.c.seq == previews.c.task).order_by(
            tasks.c.finished_at.desc()
        )
    rows = connection.execute(query.order_by(samples.c.slot).limit(count))
    return [
        Preview(
            slot=row.slot, labels=json.loads(row.labels), href=link(f"/v1/previews/{row.digest}")
        )
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
    """Return the events of a job whose ids are above `after`."""
    query = select(events.c.id, events.c.name, events.c.data).where(
        events.c.job == job, events.c.id > after
    )
    rows = connection.execute(query.order_by(events.c.id).limit(limit))
    return [StoredEvent(row.id, EventName(row.name), row.data) for row in rows]


class SlowTask(NamedTuple):
    """A finished task with its durations [s]."""

    task_id: str
    stage: str
    cost_group: str
    cpu_seconds: float | None
    wall_seconds: float


def slowest_tasks(connection: Connection, job: int, count: int) -> list[SlowTask]:
    """Return the finished tasks of a job that took longest."""
    columns = tasks.c
    rows = connection.execute(
        select(
            columns.key,
            columns.stage,
            columns.cost_group,
            columns.cpu_seconds,
            columns.wall_seconds,
        )
        .join(job_tasks, job_tasks.c.task == columns.seq)
        .where(job_tasks.c.job == job, columns.wall_seconds.is_not(None))
        .order_by(columns.wall_seconds.desc())
        .limit(count)
    )
    return [SlowTask(task_id(row.stage, row.key), *row[1:]) for row in rows]


def is_preview(connection: Connection, digest: str) -> bool:
    """Return whether an artifact is a preview, which the API serves without a dataset.

    A preview of a job that the principal does not see does not count.
    """
    query = select(previews.c.task).where(
        previews.c.digest == digest, is_visible_task(previews.c.task)
    )
    return connection.scalar(query.limit(1)) is not None


def _entries(
    connection: Connection,
    rows: Sequence[Row[tuple[object, ...]]],
    slots: Mapping[int, int],
    frames: Frames,
) -> list[Job]:
    """Return rows of `jobs` as the API shows them.

    `slots` is the number of tasks that can run at once, of the jobs whose time left is estimated.
    """
    progress = read_progress(connection, rows, slots, frames)
    entries: list[Job] = []
    for row in rows:
        progress_of_job = progress[row.seq]
        entries.append(
            document_of(
                Job,
                row,
                rejected_count=row.rejected_count or rejected_samples(progress_of_job),
                progress=progress_of_job,
                dataset=None if row.manifest is None else document_of(DatasetRef, row),
            )
        )
    return entries


_HAS_ETA = (JobState.queued, JobState.running)
"""States of a job whose time left is estimated.

In other states the work is not known, or rests.
"""


def _slots_by_job(
    rows: Sequence[Row[tuple[object, ...]]], workers: Collection[RegisteredWorker]
) -> dict[int, int]:
    """Return the number of tasks that can run at once, of each job with an estimated time left."""
    return {row.seq: _slots_of(row, workers) for row in rows if row.state in _HAS_ETA}


def _slots_of(row: Row[tuple[object, ...]], workers: Collection[RegisteredWorker]) -> int:
    """Return the number of tasks of a job that can run at once."""
    try:
        inputs = plan_inputs_of(row)
    except DamagedRowError:
        return 0  # a list shows the other jobs; this one is about to fail
    return 0 if inputs is None else count_slots(workers, row.kind, inputs.builds)
