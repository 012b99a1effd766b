"""The ledger of a write transaction: its changes of tasks, and the jobs that it ends.

Who changes `tasks.state` tells the ledger. `closing.close` then brings counters and jobs up to date, in the same
transaction.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Self

from sqlalchemy import Column, Connection, Row, bindparam, case, select, text, update
from stickslip_schemas.base.states import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.responses import DatasetRef, TaskStateEvent

from stickslip_services.database.database import batches
from stickslip_services.database.paging import document_of
from stickslip_services.database.prepared import Counters, Prepared
from stickslip_services.database.tables import job_counts, job_groups, job_tasks, jobs, task_counts, tasks
from stickslip_services.queue.eta import Run
from stickslip_services.queue.ids import task_id

RUNNABLE = (JobState.planning, JobState.queued, JobState.running)
"""States of a job whose tasks may be leased; a `planning` job has only a part of them."""

LIVE = (*RUNNABLE, JobState.pausing, JobState.paused)
"""States of a job that needs its tasks."""

PIECE_TASKS = 250
"""Tasks of a cancelled job that one transaction gives up: it takes 10 to 30 ms, for which other writers wait."""

_WAITING = (TaskState.pending, TaskState.soft_failed)

READY = text("tasks.state = 'pending' AND tasks.waiting_on = 0")
"""The condition of tasks that can be leased, in the words of the partial index."""

OVER = tuple(state for state in TaskState if state.is_over)
"""States of a finished task."""


@dataclass(frozen=True, slots=True)
class Holder:
    """A job that has a task, and whether the task was settled before the job was submitted."""

    job: int
    cached: bool
    cost_group: str
    """Cost group of the task."""


@dataclass(frozen=True, slots=True)
class Ending:
    """The end state of a job, and the dataset version that it has made or found."""

    state: JobState
    reason: Reason | None
    message: str
    dataset: DatasetRef | None = None
    rejected_count: int = 0

    @staticmethod
    def published(version: Row[Any]) -> "Ending":
        """Return the ending of a job whose dataset version, a row of `dataset_versions`, exists."""
        reference, lost = document_of(DatasetRef, version), version.sample_count - version.valid_count
        if lost == 0:
            return Ending(JobState.succeeded, None, "", reference)
        message = f"{lost} of {version.sample_count} samples were rejected; the dataset lists them with their reasons"
        return Ending(JobState.succeeded_with_rejects, None, message, reference, lost)


@dataclass(frozen=True, slots=True)
class Task:
    """A task in a state."""

    seq: int
    stage: Stage
    state: TaskState

    @classmethod
    def columns(cls) -> list[Column[Any]]:
        """Return the columns of `tasks` from which `of` makes one."""
        return [tasks.c[field.name] for field in fields(cls)]

    @classmethod
    def of(cls, row: Any) -> Self:
        """Return the task of a row with `columns`."""
        rest = (getattr(row, field.name) for field in fields(cls)[3:])
        return cls(row.seq, Stage(row.stage), TaskState(row.state), *rest)


@dataclass(frozen=True, slots=True)
class KeyedTask(Task):
    """A task with its content key."""

    key: bytes

    @property
    def name(self) -> str:
        """Name of the task outside the database."""
        return task_id(self.stage, self.key)


@dataclass(frozen=True, slots=True)
class HeldTask(KeyedTask):
    """A leased task, or one whose lease has just ended."""

    tries: int
    losses: int
    token: int
    expires_at: float


_HOLDERS = Prepared(
    select(job_tasks.c.task, job_tasks.c.job, job_tasks.c.cached, tasks.c.cost_group)
    .join(jobs, jobs.c.seq == job_tasks.c.job)
    .join(tasks, tasks.c.seq == job_tasks.c.task)
    .where(
        job_tasks.c.task.in_(bindparam("b_tasks", expanding=True)),
        jobs.c.state.in_([state for state in JobState if state.is_open]),
    )
)
TASK_COUNTS, JOB_COUNTS, JOB_GROUPS = Counters(task_counts), Counters(job_counts), Counters(job_groups)


class Ledger:
    """The changes of one write transaction."""

    def __init__(self, connection: Connection, now: float) -> None:
        self.connection = connection
        self.now = now
        self.moves: list[tuple[Task, TaskState]] = []
        """Tasks, and their new states."""
        self.runs: list[Run] = []
        self.inserted: Counter[tuple[Stage, TaskState]] = Counter()
        """New tasks by stage and state."""
        self.news: list[tuple[int, TaskStateEvent]] = []
        self.endings: dict[int, Ending] = {}

    def moved(self, task: Task, state: TaskState) -> None:
        """Note the new state of a task."""
        self.moves.append((task, state))

    def ran(self, run: Run) -> None:
        """Note the cost of a task."""
        self.runs.append(run)

    def emit(self, task: HeldTask, state: TaskState, reason: Reason, message: str) -> None:
        """Note an event of all jobs of a task."""
        event = TaskStateEvent(task_id=task.name, stage=task.stage, state=state, reason=reason, message=message)
        self.news.append((task.seq, event))

    def end_job(self, job: int, ending: Ending) -> None:
        """Note that a live job ends; the first ending counts."""
        self.endings.setdefault(job, ending)

    def holders(self, task_seqs: Iterable[int]) -> dict[int, list[Holder]]:
        """Return the open jobs of each task."""
        found: dict[int, list[Holder]] = {}
        for batch in batches(set(task_seqs)):
            for task, job, cached, cost_group in _HOLDERS.tuples(self.connection, {"b_tasks": batch}):
                found.setdefault(task, []).append(Holder(job, bool(cached), cost_group))
        return found


def give_up_tasks(book: Ledger, job: int, *, ending: Collection[int] = ()) -> None:
    """Cancel the waiting tasks of a job that is ending; leave those that another live job, not `ending`, needs.

    Tasks that are leased are left: they end by themselves, or the next heartbeat drops them.
    """
    for batch in batches(_waiting_tasks(book.connection, job)):
        _give_up(book, batch, ending)


def give_up_piece(book: Ledger, job: int, after: int) -> int | None:
    """Do as `give_up_tasks` for the next `PIECE_TASKS` tasks after the one with the seq `after`.

    Return the seq of the last one; None if there is no other.
    """
    piece = select(job_tasks.c.task).where(job_tasks.c.job == job, job_tasks.c.task > after)
    seqs = list(book.connection.scalars(piece.order_by(job_tasks.c.task).limit(PIECE_TASKS)))
    rows = book.connection.execute(select(*Task.columns()).where(tasks.c.seq.in_(seqs), tasks.c.state.in_(_WAITING)))
    _give_up(book, list(map(Task.of, rows)), ())
    return seqs[-1] if len(seqs) == PIECE_TASKS else None


def _give_up(book: Ledger, waiting: Collection[Task], ending: Collection[int]) -> None:
    chargeable = live_jobs(book.connection, [task.seq for task in waiting], but=ending)
    _charge(book.connection, chargeable)
    cancel_tasks(book, [task for task in waiting if task.seq not in chargeable])


def charge_waiting_tasks(connection: Connection, job: int) -> None:
    """Charge each waiting task of a live job to the job that it will run for, preferably a runnable one.

    Called whenever a job starts or stops being runnable, or changes its priority, for a task is leased only on behalf
    of the job it is charged to.
    """
    kind = select(jobs.c.kind).where(jobs.c.seq == job).scalar_subquery()
    others = select(jobs.c.seq).where(jobs.c.seq != job, jobs.c.kind == kind, jobs.c.state.in_(LIVE))
    if connection.scalar(others.limit(1)) is not None:  # otherwise all are charged to this one already
        charge_tasks(connection, (task.seq for task in _waiting_tasks(connection, job)))


def charge_tasks(connection: Connection, waiting: Iterable[int]) -> None:
    """Charge waiting tasks to the jobs that they will run for."""
    for batch in batches(waiting):
        _charge(connection, live_jobs(connection, batch))


def _waiting_tasks(connection: Connection, job: int) -> list[Task]:
    """Return the tasks of a job that wait to be leased."""
    rows = connection.execute(
        select(*Task.columns())
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.state.in_(_WAITING))
    )
    return list(map(Task.of, rows))


def _charge(connection: Connection, job_of: dict[int, int]) -> None:
    charges = [{"b_seq": task, "b_job": job} for task, job in job_of.items()]
    if charges:
        connection.execute(
            update(tasks).where(tasks.c.seq == bindparam("b_seq")).values(job=bindparam("b_job")), charges
        )


def cancel_tasks(book: Ledger, needless: Collection[Task]) -> None:
    """Cancel tasks, leased ones included."""
    if not needless:
        return
    book.connection.execute(
        update(tasks)
        .where(tasks.c.seq.in_([task.seq for task in needless]))
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
    for task in needless:
        book.moved(task, TaskState.cancelled)


def release(book: Ledger, task: HeldTask, state: TaskState, **values: object) -> None:
    """Take a task off its lease into another state; `values` are further columns to write."""
    book.connection.execute(
        update(tasks).where(tasks.c.seq == task.seq).values(state=state, owner=None, expires_at=None, **values)
    )
    book.moved(task, state)


def reset_tasks(book: Ledger, ended: Collection[Task], job_of: Mapping[int, int]) -> None:
    """Let ended tasks run again, with all their tries, each charged to a job."""
    values = {"reason": None, "message": "", "tries": 0, "losses": 0, "retry_at": None, "finished_at": None}
    if ended:
        book.connection.execute(
            update(tasks)
            .where(tasks.c.seq == bindparam("b_seq"))
            .values(state=TaskState.pending, job=bindparam("b_job"), **values),
            [{"b_seq": task.seq, "b_job": job_of[task.seq]} for task in ended],
        )
    for task in ended:
        book.moved(task, TaskState.pending)


_START = Prepared(
    update(tasks)
    .where(tasks.c.seq.in_(bindparam("b_tasks", expanding=True)))
    .values(state=TaskState.running, attempts=tasks.c.attempts + 1, started_at=bindparam("b_now"))
)


def start_tasks(book: Ledger, leased: Collection[Task]) -> None:
    """Note that leased tasks have been started: from here on they may fail."""
    for batch in batches(leased):
        _START.run(book.connection, {"b_tasks": [task.seq for task in batch], "b_now": book.now})
    for task in leased:
        book.moved(task, TaskState.running)


_OF_TASKS = job_tasks.c.task.in_(bindparam("b_tasks", expanding=True))
_LIVE_JOBS = Prepared(
    select(job_tasks.c.task, case((jobs.c.state.in_(RUNNABLE), 0), else_=1), jobs.c.priority, job_tasks.c.job)
    .join(jobs, jobs.c.seq == job_tasks.c.job)
    .where(_OF_TASKS, jobs.c.state.in_(LIVE))
)
_RUNNABLE_TASKS = Prepared(
    select(job_tasks.c.task).join(jobs, jobs.c.seq == job_tasks.c.job).where(_OF_TASKS, jobs.c.state.in_(RUNNABLE))
)


def live_jobs(connection: Connection, task_seqs: Iterable[int], *, but: Collection[int] = ()) -> dict[int, int]:
    """Return the first runnable job of each task, or else its first live one; tasks without any are left out.

    First is the one of the highest priority, and of these the oldest. Jobs in `but` are left out.
    """
    found: dict[int, tuple[int, int, int]] = {}
    for batch in batches(task_seqs):
        for task, halted, priority, job in _LIVE_JOBS.tuples(connection, {"b_tasks": batch}):
            if job not in but:
                mine = (halted, -priority, job)
                found[task] = min(mine, found.get(task, mine))
    return {task: job for task, (_, _, job) in found.items()}


def runnable_tasks(connection: Connection, task_seqs: Iterable[int]) -> set[int]:
    """Return the tasks that a runnable job needs."""
    return {task for batch in batches(task_seqs) for (task,) in _RUNNABLE_TASKS.tuples(connection, {"b_tasks": batch})}
