"""Moving tasks between states, with every counter and every job kept right in the same transaction.

Who changes `tasks.state` tells the ledger. On closing it brings the counters up to date and lets the jobs follow:
queued -> running at the first lease, cancelling -> cancelled when nothing of theirs runs any more.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from sqlalchemy import Connection, bindparam, func, select, text, update
from stickslip_schemas.states import JobState, Reason, Stage, TaskState

from stickslip_services import events
from stickslip_services.db import batches
from stickslip_services.tables import job_counts, job_stages, job_tasks, jobs, task_counts, tasks

LIVE = (JobState.queued, JobState.running)
"""States of a job that needs its tasks."""

OPEN = (*LIVE, JobState.cancelling)
"""States of a job whose counters follow its tasks; those of an ended job stay as they were at its end."""


@dataclass(frozen=True, slots=True)
class Holder:
    """A job that has a task, and whether the task was settled before the job came."""

    job: int
    cached: bool


@dataclass(frozen=True, slots=True)
class Ending:
    """How a job ends."""

    state: JobState
    reason: Reason | None
    message: str


@dataclass(frozen=True, slots=True)
class Run:
    """A task that was really run: what it cost."""

    task: int
    stage: Stage
    kind: str
    cpu_seconds: float
    wall_seconds: float


class Ledger:
    """What one write transaction does to tasks."""

    def __init__(self, connection: Connection, now: float) -> None:
        self.connection = connection
        self.now = now
        self._moves: list[tuple[int, Stage, TaskState, TaskState]] = []
        self._runs: list[Run] = []
        self._endings: dict[int, Ending] = {}

    def moved(self, task: int, stage: str, old: str, new: TaskState) -> None:
        """Note that a task has gone from one state to another."""
        self._moves.append((task, Stage(stage), TaskState(old), new))

    def ran(self, run: Run) -> None:
        """Note what a task cost."""
        self._runs.append(run)

    def end_job(self, job: int, ending: Ending) -> None:
        """Note that a live job ends here; the first ending counts."""
        self._endings.setdefault(job, ending)

    def holders(self, task_seqs: Iterable[int]) -> dict[int, list[Holder]]:
        """Return the open jobs of each task."""
        found: dict[int, list[Holder]] = {}
        for batch in batches(set(task_seqs)):
            rows = self.connection.execute(
                select(job_tasks.c.task, job_tasks.c.job, job_tasks.c.cached)
                .join(jobs, jobs.c.seq == job_tasks.c.job)
                .where(job_tasks.c.task.in_(batch), jobs.c.state.in_(OPEN))
            )
            for task, job, cached in rows:
                found.setdefault(task, []).append(Holder(job, cached))
        return found

    def close(self) -> None:
        """Bring counters and jobs up to date."""
        for job in self._endings:
            give_up_tasks(self, job, ending=self._endings.keys())
        moves, self._moves = self._moves, []
        runs, self._runs = self._runs, []
        if moves or runs:
            holders = self.holders([*(move[0] for move in moves), *(run.task for run in runs)])
            self._count(moves, holders)
            self._add_costs(runs, holders)
            leased = (move[0] for move in moves if move[3] in (TaskState.leased, TaskState.running))
            self._start_jobs({holder.job for task in leased for holder in holders.get(task, ())})
        for job, ending in self._endings.items():
            set_job_state(self.connection, job, ending.state, self.now, reason=ending.reason, message=ending.message)
        finish_cancelling(self.connection, self.now)

    def _count(self, moves: list[tuple[int, Stage, TaskState, TaskState]], holders: dict[int, list[Holder]]) -> None:
        overall: Counter[tuple[Stage, TaskState]] = Counter()
        by_job: Counter[tuple[int, Stage, TaskState]] = Counter()
        for task, stage, old, new in moves:
            overall[stage, old] -= 1
            overall[stage, new] += 1
            for holder in holders.get(task, ()):
                by_job[holder.job, stage, old] -= 1
                by_job[holder.job, stage, new] += 1
        add_to_task_counts(self.connection, overall)
        changes = [
            {"b_job": job, "b_stage": stage, "b_state": state, "b_change": change}
            for (job, stage, state), change in by_job.items()
            if change
        ]
        if changes:
            self.connection.execute(
                update(job_counts)
                .where(
                    job_counts.c.job == bindparam("b_job"),
                    job_counts.c.stage == bindparam("b_stage"),
                    job_counts.c.state == bindparam("b_state"),
                )
                .values(count=job_counts.c.count + bindparam("b_change")),
                changes,
            )

    def _add_costs(self, runs: list[Run], holders: dict[int, list[Holder]]) -> None:
        by_job: dict[tuple[int, Stage], list[Run]] = {}
        by_kind: dict[tuple[Stage, str], list[Run]] = {}
        for run in runs:
            by_kind.setdefault((run.stage, run.kind), []).append(run)
            for holder in holders.get(run.task, ()):
                if not holder.cached:
                    by_job.setdefault((holder.job, run.stage), []).append(run)
        for (job, stage), group in by_job.items():
            self.connection.execute(
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
            self.connection.execute(
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

    def _start_jobs(self, job_seqs: Collection[int]) -> None:
        if not job_seqs:
            return
        queued = self.connection.scalars(
            select(jobs.c.seq).where(jobs.c.seq.in_(job_seqs), jobs.c.state == JobState.queued)
        ).all()
        for job in queued:
            set_job_state(self.connection, job, JobState.running, self.now)


@contextmanager
def ledger(connection: Connection, now: float) -> Iterator[Ledger]:
    """Open a ledger and close it, unless the block raises."""
    book = Ledger(connection, now)
    yield book
    book.close()


def add_to_task_counts(connection: Connection, changes: Counter[tuple[Stage, TaskState]]) -> None:
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


def set_job_state(
    connection: Connection,
    job: int,
    state: JobState,
    now: float,
    *,
    reason: Reason | None = None,
    message: str = "",
) -> None:
    """Give a job another state and tell it in an event."""
    values: dict[str, object] = {"state": state, "reason": reason, "message": message}
    if state is JobState.running:
        values["started_at"] = func.coalesce(jobs.c.started_at, now)
    if state.is_terminal:
        values["finished_at"] = now
    connection.execute(update(jobs).where(jobs.c.seq == job).values(values))
    events.append_job_state(connection, job, state, reason, message, now)


def give_up_tasks(book: Ledger, job: int, *, ending: Collection[int] = ()) -> None:
    """Cancel the waiting tasks of a job that is ending; leave those that another live job, not `ending`, needs.

    Tasks that are leased are left: they end by themselves, or the next heartbeat drops them.
    """
    waiting = book.connection.execute(
        select(tasks.c.seq, tasks.c.stage, tasks.c.state)
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.state.in_((TaskState.pending, TaskState.soft_failed)))
    ).all()
    for batch in batches(waiting):
        heirs = live_jobs(book.connection, [row.seq for row in batch], but=ending)
        charged = [{"b_seq": row.seq, "b_job": heirs[row.seq]} for row in batch if row.seq in heirs]
        if charged:
            book.connection.execute(
                update(tasks).where(tasks.c.seq == bindparam("b_seq")).values(job=bindparam("b_job")), charged
            )
        orphans = [row for row in batch if row.seq not in heirs]
        cancel_tasks(book, [(row.seq, row.stage, row.state) for row in orphans])


def cancel_tasks(book: Ledger, rows: Collection[tuple[int, str, str]]) -> None:
    """Cancel tasks (seq, stage, state), whoever has them on lease."""
    if not rows:
        return
    book.connection.execute(
        update(tasks)
        .where(tasks.c.seq.in_([row[0] for row in rows]))
        .values(
            state=TaskState.cancelled,
            reason=Reason.cancelled,
            message="no job needs it",
            owner=None,
            expires_at=None,
            retry_at=None,
            finished_at=book.now,
        )
    )
    for seq, stage, state in rows:
        book.moved(seq, stage, state, TaskState.cancelled)


def live_jobs(connection: Connection, task_seqs: Iterable[int], *, but: Collection[int] = ()) -> dict[int, int]:
    """Return the oldest live job, `but` those named, of each of the tasks that have one."""
    found: dict[int, int] = {}
    for batch in batches(task_seqs):
        rows = connection.execute(
            select(job_tasks.c.task, job_tasks.c.job)
            .join(jobs, jobs.c.seq == job_tasks.c.job)
            .where(job_tasks.c.task.in_(batch), jobs.c.state.in_(LIVE))
        )
        for task, job in rows:
            if job not in but:
                found[task] = min(job, found.get(task, job))
    return found


def finish_cancelling(connection: Connection, now: float) -> None:
    """Let jobs that were being cancelled be so when no task that only they had is on lease any more."""
    cancelling = connection.scalars(
        select(jobs.c.seq).where(
            text("jobs.state IN ('queued', 'running', 'cancelling')"), jobs.c.state == "cancelling"
        )
    ).all()
    for job in cancelling:
        held = connection.scalars(
            select(tasks.c.seq)
            .join(job_tasks, job_tasks.c.task == tasks.c.seq)
            .where(text("tasks.owner IS NOT NULL"), job_tasks.c.job == job)
        ).all()
        if not set(held) - live_jobs(connection, held).keys():
            message = "cancelled; what had been finished is kept and will not be done again"
            set_job_state(connection, job, JobState.cancelled, now, reason=Reason.cancelled, message=message)
