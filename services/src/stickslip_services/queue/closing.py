"""Closing a ledger: counters follow the tasks, and jobs follow the counters.

queued -> running at the first lease; cancelling -> cancelled, and pausing -> paused, when none of their tasks runs any
more; a job of which only quarantined tasks are left -> failed; then the noted endings are applied.
"""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, exists, func, select, text, update
from stickslip_schemas.base.states import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.responses import DatasetPublishedEvent, EventName

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_counts, job_tasks, jobs, tasks
from stickslip_services.queue.eta import Run, add_costs
from stickslip_services.queue.events import append_event, set_job_state
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.ledger import (
    JOB_COUNTS,
    JOB_GROUPS,
    OVER,
    READY,
    RUNNABLE,
    TASK_COUNTS,
    Ending,
    Holder,
    Ledger,
    Task,
    give_up_tasks,
    live_jobs,
    runnable_tasks,
)

# In the words of the partial index.
_OPEN = text("jobs.state IN ('planning', 'queued', 'running', 'pausing', 'paused', 'cancelling')")
_OPEN_JOBS = Prepared(
    "SELECT seq, state, (SELECT SUM(count) FROM job_counts WHERE job = jobs.seq AND state = 'failed') FROM jobs "
    f"WHERE {_OPEN.text}"
)
_NOT_STARTED = Prepared(
    f"SELECT seq, state FROM jobs WHERE {_OPEN.text} AND (jobs.state = 'queued' "
    "OR (jobs.state = 'planning' AND jobs.started_at IS NULL))"
)
_PLANNED = frozenset(RUNNABLE) - {JobState.planning}
_ADD_TO_JOB_STAGES = Prepared(
    "UPDATE job_stages SET cpu_seconds = cpu_seconds + :b_cpu, wall_count = wall_count + :b_count, "
    "wall_sum = wall_sum + :b_wall, wall_squares = wall_squares + :b_squares WHERE job = :b_job AND stage = :b_stage"
)


@contextmanager
def ledger(connection: Connection, now: float) -> Iterator[Ledger]:
    """Open a ledger and close it, unless the block raises."""
    book = Ledger(connection, now)
    yield book
    close(book)


def close(book: Ledger) -> None:
    """Update counters and jobs from the moves and endings of the ledger."""
    given_up = _settle(book, frozenset())
    open_jobs = _OPEN_JOBS.tuples(book.connection)
    for job in _blocked_jobs(
        book.connection, [seq for seq, state, failed in open_jobs if state in _PLANNED and failed]
    ):
        book.end_job(job, _quarantined(book.connection, job))
    _settle(book, given_up)
    holders = book.holders(task for task, _ in book.news)
    for task, event in book.news:
        for holder in holders.get(task, ()):
            append_event(book, holder.job, EventName.task_state, event)
    for job, ending in book.endings.items():
        _end_job(book, job, ending)
    if not {JobState.cancelling, JobState.pausing}.isdisjoint(state for _, state, _ in open_jobs):
        _finish_cancelling(book)
        _finish_pausing(book)


def _settle(book: Ledger, given_up: frozenset[int]) -> frozenset[int]:
    """Give up the tasks of ending jobs, and update the counters; return the jobs whose tasks are given up."""
    for job in book.endings.keys() - given_up:
        give_up_tasks(book, job, ending=book.endings.keys())
    moves, book.moves = book.moves, []
    runs, book.runs = book.runs, []
    inserted, book.inserted = book.inserted, Counter()
    TASK_COUNTS.add(book.connection, inserted)
    if moves or runs:
        holders = book.holders([*(task.seq for task, _ in moves), *(run.task for run in runs)])
        _count(book.connection, moves, holders)
        _add_costs(book.connection, runs, holders)
        leased = (task.seq for task, state in moves if state in (TaskState.leased, TaskState.running))
        _start_jobs(book, {holder.job for task in leased for holder in holders.get(task, ())})
    return frozenset(book.endings)


def _blocked_jobs(connection: Connection, quarantined: list[int]) -> list[int]:
    """Return the planned jobs with quarantined tasks for which nothing runs, and nothing can be leased."""
    if not quarantined:
        return []
    counts = job_counts.c
    busy = (TaskState.leased, TaskState.running, TaskState.soft_failed)
    idle = connection.scalars(
        select(counts.job)
        .where(counts.job.in_(quarantined))
        .group_by(counts.job)
        .having(func.sum(counts.count).filter(counts.state.in_(busy)) == 0)
    ).all()
    ready = select(tasks.c.seq).join(job_tasks, job_tasks.c.task == tasks.c.seq).where(READY)
    return [job for job in idle if connection.scalar(ready.where(job_tasks.c.job == job).limit(1)) is None]


def _quarantined(connection: Connection, job: int) -> Ending:
    """Return the ending of a job of which only quarantined tasks, and their dependents, are left."""
    failed = (
        select(tasks.c.key, tasks.c.stage, tasks.c.message)
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.state == TaskState.failed)
        .order_by(tasks.c.seq)
    )
    rows = connection.execute(failed).all()
    first = rows[0]
    message = (
        f"everything else is done, but {len(rows)} of its tasks were quarantined; the first is "
        f"{task_id(first.stage, first.key)}: {first.message}. What is done is kept; submit the job again to try again"
    )
    return Ending(JobState.failed, Reason.quarantined, message)


def _end_job(book: Ledger, job: int, ending: Ending) -> None:
    if ending.dataset is not None:
        book.connection.execute(
            update(jobs)
            .where(jobs.c.seq == job)
            .values(**ending.dataset.model_dump(), rejected_count=ending.rejected_count)
        )
        append_event(book, job, EventName.dataset_published, DatasetPublishedEvent(dataset=ending.dataset))
    set_job_state(book, job, ending.state, reason=ending.reason, message=ending.message)


def _count(connection: Connection, moves: list[tuple[Task, TaskState]], holders: dict[int, list[Holder]]) -> None:
    overall: Counter[tuple[Stage, TaskState]] = Counter()
    by_job: Counter[tuple[int, Stage, TaskState]] = Counter()
    left: Counter[tuple[int, Stage, str]] = Counter()
    for task, new in moves:
        for state, change in ((task.state, -1), (new, 1)):
            overall[task.stage, state] += change
            for holder in holders.get(task.seq, ()):
                by_job[holder.job, task.stage, state] += change
                left[holder.job, task.stage, holder.cost_group] += change * (state not in OVER)
    TASK_COUNTS.add(connection, overall)
    JOB_COUNTS.add(connection, by_job)
    JOB_GROUPS.add(connection, {group: change for group, change in left.items() if change})


def _add_costs(connection: Connection, runs: list[Run], holders: dict[int, list[Holder]]) -> None:
    by_job: dict[tuple[int, Stage], list[Run]] = {}
    for run in runs:
        for holder in holders.get(run.task, ()):
            if not holder.cached:
                by_job.setdefault((holder.job, run.stage), []).append(run)
    rows = [
        {
            "b_job": job,
            "b_stage": stage,
            "b_cpu": sum(run.cpu_seconds for run in group),
            "b_count": len(group),
            "b_wall": sum(run.wall_seconds for run in group),
            "b_squares": sum(run.wall_seconds**2 for run in group),
        }
        for (job, stage), group in by_job.items()
    ]
    _ADD_TO_JOB_STAGES.run_all(connection, rows)
    add_costs(connection, runs)


def _start_jobs(book: Ledger, job_seqs: Collection[int]) -> None:
    if not job_seqs:
        return
    for job, state in _NOT_STARTED.tuples(book.connection):
        if job not in job_seqs:
            continue
        if state == JobState.queued:
            set_job_state(book, job, JobState.running)
        else:  # it runs when it has been planned
            book.connection.execute(update(jobs).where(jobs.c.seq == job).values(started_at=book.now))


def _finish_cancelling(book: Ledger) -> None:
    """Cancel the `cancelling` jobs of which no task waits or is on lease any more, unless another job needs it."""
    given_up = select(jobs.c.seq).where(_OPEN, jobs.c.state == JobState.cancelling, jobs.c.given_up.is_(None))
    for job in book.connection.scalars(given_up).all():
        held = held_tasks(book.connection, job)
        if not set(held) - live_jobs(book.connection, held).keys():
            message = "cancelled; what had been finished is kept and will not be done again"
            set_job_state(book, job, JobState.cancelled, reason=Reason.cancelled, message=message)


def _finish_pausing(book: Ledger) -> None:
    """Pause the `pausing` jobs of which no task is on lease any more, unless a runnable job needs it."""
    pausing = select(jobs.c.seq, jobs.c.reason, jobs.c.message).where(_OPEN, jobs.c.state == JobState.pausing)
    for job, reason, message in book.connection.execute(pausing).all():
        held = held_tasks(book.connection, job)
        if not set(held) - runnable_tasks(book.connection, held):
            shown = message if reason else "paused; resume it to go on"
            set_job_state(book, job, JobState.paused, reason=reason, message=shown)


def held_tasks(connection: Connection, job: int) -> list[int]:
    """Return the tasks of a job that are on lease; found among all tasks on lease, which are fewer than a job has."""
    is_of_job = exists().where(job_tasks.c.job == job, job_tasks.c.task == tasks.c.seq)
    return list(connection.scalars(select(tasks.c.seq).where(text("tasks.owner IS NOT NULL"), is_of_job)))
