"""Closing a ledger: counters follow the tasks, and jobs follow the counters.

queued -> running at the first lease; cancelling -> cancelled, and pausing -> paused, when nothing of theirs runs any
more; the endings that were noted come true.
"""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, bindparam, select, text, update
from stickslip_schemas.states import JobState, Reason, Stage, TaskState

from stickslip_services.database.tables import job_counts, job_stages, job_tasks, jobs, task_counts, tasks
from stickslip_services.queue.events import append_published, append_task_state, set_job_state
from stickslip_services.queue.ledger import Ending, Holder, Ledger, Move, Run, give_up_tasks, live_jobs, runnable_tasks

_OPEN = text("jobs.state IN ('queued', 'running', 'pausing', 'paused', 'cancelling')")  # the partial index's words


@contextmanager
def ledger(connection: Connection, now: float) -> Iterator[Ledger]:
    """Open a ledger and close it, unless the block raises."""
    book = Ledger(connection, now)
    yield book
    close(book)


def close(book: Ledger) -> None:
    """Bring counters and jobs up to date with what the ledger has noted."""
    for job in book.endings:
        give_up_tasks(book, job, ending=book.endings.keys())
    moves, book.moves = book.moves, []
    runs, book.runs = book.runs, []
    _add_to_task_counts(book.connection, book.inserted)
    if moves or runs:
        holders = book.holders([*(move.task for move in moves), *(run.task for run in runs)])
        _count(book.connection, moves, holders)
        _add_costs(book.connection, runs, holders)
        leased = (move.task for move in moves if move.new in (TaskState.leased, TaskState.running))
        _start_jobs(book, {holder.job for task in leased for holder in holders.get(task, ())})
    _tell(book)
    for job, ending in book.endings.items():
        _end_job(book, job, ending)
    _finish_cancelling(book.connection, book.now)
    _finish_pausing(book.connection, book.now)


def _tell(book: Ledger) -> None:
    holders = book.holders(task for task, _ in book.news)
    for task, event in book.news:
        for holder in holders.get(task, ()):
            append_task_state(book.connection, holder.job, event, book.now)


def _end_job(book: Ledger, job: int, ending: Ending) -> None:
    if ending.dataset is not None:
        book.connection.execute(
            update(jobs)
            .where(jobs.c.seq == job)
            .values(**ending.dataset.model_dump(), rejected_count=ending.rejected_count)
        )
        append_published(book.connection, job, ending.dataset, book.now)
    set_job_state(book.connection, job, ending.state, book.now, reason=ending.reason, message=ending.message)


def _count(connection: Connection, moves: list[Move], holders: dict[int, list[Holder]]) -> None:
    overall: Counter[tuple[Stage, TaskState]] = Counter()
    by_job: Counter[tuple[int, Stage, TaskState]] = Counter()
    for move in moves:
        overall[move.stage, move.old] -= 1
        overall[move.stage, move.new] += 1
        for holder in holders.get(move.task, ()):
            by_job[holder.job, move.stage, move.old] -= 1
            by_job[holder.job, move.stage, move.new] += 1
    _add_to_task_counts(connection, overall)
    changes = [
        {"b_job": job, "b_stage": stage, "b_state": state, "b_change": change}
        for (job, stage, state), change in by_job.items()
        if change
    ]
    if changes:
        connection.execute(
            update(job_counts)
            .where(
                job_counts.c.job == bindparam("b_job"),
                job_counts.c.stage == bindparam("b_stage"),
                job_counts.c.state == bindparam("b_state"),
            )
            .values(count=job_counts.c.count + bindparam("b_change")),
            changes,
        )


def _add_costs(connection: Connection, runs: list[Run], holders: dict[int, list[Holder]]) -> None:
    by_job: dict[tuple[int, Stage], list[Run]] = {}
    by_kind: dict[tuple[Stage, str], list[Run]] = {}
    for run in runs:
        by_kind.setdefault((run.stage, run.kind), []).append(run)
        for holder in holders.get(run.task, ()):
            if not holder.cached:
                by_job.setdefault((holder.job, run.stage), []).append(run)
    for (job, stage), group in by_job.items():
        connection.execute(
            update(job_stages)
            .where(job_stages.c.job == job, job_stages.c.stage == stage)
            .values(
                cpu_seconds=job_stages.c.cpu_seconds + sum(run.cpu_seconds for run in group),
                wall_count=job_stages.c.wall_count + len(group),
                wall_sum=job_stages.c.wall_sum + sum(run.wall_seconds for run in group),
                wall_squares=job_stages.c.wall_squares + sum(run.wall_seconds**2 for run in group),
            )
        )
    for (stage, kind), group in by_kind.items():
        connection.execute(
            text(
                "INSERT INTO stage_timings (stage, kind, wall_count, wall_sum, wall_squares) "
                "VALUES (:stage, :kind, :n, :total, :squares) ON CONFLICT (stage, kind) DO UPDATE SET "
                "wall_count = stage_timings.wall_count + excluded.wall_count, "
                "wall_sum = stage_timings.wall_sum + excluded.wall_sum, "
                "wall_squares = stage_timings.wall_squares + excluded.wall_squares"
            ),
            {
                "stage": stage,
                "kind": kind,
                "n": len(group),
                "total": sum(run.wall_seconds for run in group),
                "squares": sum(run.wall_seconds**2 for run in group),
            },
        )


def _start_jobs(book: Ledger, job_seqs: Collection[int]) -> None:
    if not job_seqs:
        return
    queued = book.connection.scalars(
        select(jobs.c.seq).where(jobs.c.seq.in_(job_seqs), jobs.c.state == JobState.queued)
    ).all()
    for job in queued:
        set_job_state(book.connection, job, JobState.running, book.now)


def _add_to_task_counts(connection: Connection, changes: Counter[tuple[Stage, TaskState]]) -> None:
    """Change the number of tasks by stage and state."""
    rows = [{"stage": stage, "state": state, "change": change} for (stage, state), change in changes.items() if change]
    if rows:
        connection.execute(
            text(
                f"INSERT INTO {task_counts.name} (stage, state, count) VALUES (:stage, :state, :change) "
                "ON CONFLICT (stage, state) DO UPDATE SET count = task_counts.count + excluded.count"
            ),
            rows,
        )


def _finish_cancelling(connection: Connection, now: float) -> None:
    """Let jobs that were being cancelled be so when no task that only they had is on lease any more."""
    for job in _jobs_in(connection, JobState.cancelling):
        held = _held_tasks(connection, job)
        if not set(held) - live_jobs(connection, held).keys():
            message = "cancelled; what had been finished is kept and will not be done again"
            set_job_state(connection, job, JobState.cancelled, now, reason=Reason.cancelled, message=message)


def _finish_pausing(connection: Connection, now: float) -> None:
    """Let jobs that were being paused be so when no task runs for them alone any more."""
    for job in _jobs_in(connection, JobState.pausing):
        held = _held_tasks(connection, job)
        if not set(held) - runnable_tasks(connection, held):
            reason, message = connection.execute(select(jobs.c.reason, jobs.c.message).where(jobs.c.seq == job)).one()
            if reason is None:
                message = "paused; resume it to go on"
            set_job_state(connection, job, JobState.paused, now, reason=reason, message=message)


def _jobs_in(connection: Connection, state: JobState) -> list[int]:
    return list(connection.scalars(select(jobs.c.seq).where(_OPEN, jobs.c.state == state)))


def _held_tasks(connection: Connection, job: int) -> list[int]:
    return list(
        connection.scalars(
            select(tasks.c.seq)
            .join(job_tasks, job_tasks.c.task == tasks.c.seq)
            .where(text("tasks.owner IS NOT NULL"), job_tasks.c.job == job)
        )
    )
