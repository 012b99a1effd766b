"""The ledger of a write transaction: how the states of tasks and jobs change, and what follows from
that.

Between any two transactions (`stickslip_testing.invariants` looks at all of it):

1. A task has an owner exactly while it is `leased` or `running`, and a retry time exactly while it
   is `soft_failed`.
2. The counters, those of all tasks and those of each open job, say what the rows say.
3. A task that waits is charged to the job that it will run for: of the live jobs that need it a
   runnable one, if there is any, of these the one with the highest priority, and of these the
   oldest. No task waits that no live job needs.
4. A `queued` job has no task on lease. A `pausing` job has one that no runnable job needs, and a
   `cancelling` job one that no live job needs. A job of which only quarantined tasks and their
   dependents are left has failed.

`move` keeps the first, `reassign` the third, and `_close`, at the end of the transaction, the
second and the fourth. A job of a million tasks that ends would keep other writers waiting: its
tasks are given up in pieces (`give_up`).

Tasks are rows of `tasks` with at least `seq`, `stage` and `state`, as they were before the
transaction changed them.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from sqlalchemy import Connection, bindparam, case, exists, func, insert, or_, select, text, update
from stickslip_schemas.base import Document, JobState, Reason, TaskState
from stickslip_schemas.documents.responses import (
    DatasetPublishedEvent,
    DatasetRef,
    EventName,
    JobStateEvent,
    TaskStateEvent,
)
from stickslip_schemas.documents.tasks import TaskResult

from stickslip_services.database.database import Counters, Prepared, batches, document_of
from stickslip_services.database.tables import (
    events,
    job_counts,
    job_groups,
    job_tasks,
    jobs,
    task_counts,
    tasks,
)
from stickslip_services.queue.eta import add_costs
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.rows import Task, TaskRow, columns

RUNNABLE = (JobState.planning, JobState.queued, JobState.running)
"""States of a job whose tasks may be leased; a `planning` job has only a part of them."""

LIVE = (*RUNNABLE, JobState.pausing, JobState.paused)
"""States of a job that needs its tasks."""

WAITING = (TaskState.pending, TaskState.soft_failed)
ON_LEASE = (TaskState.leased, TaskState.running)
SETTLED = tuple(state for state in TaskState if state.is_settled)
"""States of a task with a result."""
FINISHED = tuple(state for state in TaskState if state.is_over)
"""States of a finished task."""

IS_READY = text("tasks.state = 'pending' AND tasks.waiting_on = 0")
"""The condition of tasks that can be leased, in the words of the partial index."""
IS_LEASED = text("tasks.owner IS NOT NULL")
"""The condition of tasks on lease, likewise."""

RELEASE_BATCH = 250
"""Tasks of an ended job that one transaction gives up: it takes 10 to 30 ms, for which other
writers wait.
"""

RESET_ATTEMPTS: Mapping[str, Any] = {"reason": None, "message": "", "tries": 0, "losses": 0}
"""Values of a task that has all its tries."""


TASK_COLUMNS = columns(Task)

Row = TypeVar("Row", bound=TaskRow)

_OPEN = text(
    "jobs.state IN ('planning', 'queued', 'running', 'pausing', 'paused', 'cancelling')"
)  # of its index, too
_HOLDERS = Prepared(
    select(job_tasks.c.task, job_tasks.c.job, job_tasks.c.cached, tasks.c.cost_group)
    .join(jobs, jobs.c.seq == job_tasks.c.job)
    .join(tasks, tasks.c.seq == job_tasks.c.task)
    .where(
        job_tasks.c.task.in_(bindparam("b_tasks", expanding=True)),
        or_(_OPEN, jobs.c.seq.in_(bindparam("b_given_up", expanding=True))),
    )
)
_ADD_TO_JOB_STAGES = Prepared(
    "UPDATE job_stages SET cpu_seconds = cpu_seconds + :b_cpu, wall_count = wall_count + 1, "
    "wall_sum = wall_sum + :b_wall, wall_squares = wall_squares + :b_wall * :b_wall "
    "WHERE job = :b_job AND stage = :b_stage"
)
TASK_COUNTS, JOB_COUNTS, JOB_GROUPS = (
    Counters(task_counts),
    Counters(job_counts),
    Counters(job_groups),
)


class QueueTransaction:
    """The changes of one write transaction."""

    def __init__(self, connection: Connection, now: float) -> None:
        self.connection = connection
        self.now = now
        self._moves: list[tuple[TaskRow, TaskState]] = []
        self._runs: list[tuple[Any, TaskResult]] = []
        self.released_jobs: set[int] = set()
        """Jobs whose tasks this transaction gives up: their counters follow, also after they have
        ended.
        """

    def set_task_state(self, rows: Collection[TaskRow], state: TaskState, **values: Any) -> None:
        """Put tasks into a state, and write other values of their columns."""
        if state not in ON_LEASE:
            values |= {"owner": None, "expires_at": None}
        if state is not TaskState.soft_failed:
            values["retry_at"] = None
        values["finished_at"] = self.now if state in FINISHED else None
        for batch in batches(rows):
            own = tasks.c.seq.in_([row.seq for row in batch])
            self.connection.execute(update(tasks).where(own).values(state=state, **values))
        self.record_transition(rows, state)

    def record_transition(self, rows: Iterable[TaskRow], state: TaskState) -> None:
        """Note that tasks were put into a state by other means."""
        self._moves += [(row, state) for row in rows]

    def mark_started(self, rows: Collection[TaskRow]) -> None:
        """Note that leased tasks have been started: from here on they may fail."""
        self.set_task_state(
            rows, TaskState.running, attempts=tasks.c.attempts + 1, started_at=self.now
        )

    def record_cost(self, task: Any, result: TaskResult) -> None:
        """Note the cost of a task, whose row has its kind and its cost group."""
        self._runs.append((task, result))

    def emit_task_event(self, task: Any, state: TaskState, reason: Reason, message: str) -> None:
        """Store an event of a task, whose row has its `key`, for each of its open jobs."""
        name = task_id(task.stage, task.key)
        event = TaskStateEvent(
            task_id=name, stage=task.stage, state=state, reason=reason, message=message
        )
        for job in self.open_jobs_of(task.seq):
            self._append_event(job, EventName.task_state, event)

    def set_job_state(
        self, job: int, state: JobState, *, reason: Reason | None = None, message: str = ""
    ) -> None:
        """Set the state of a job with its reason and message, and store the event."""
        values: dict[str, object] = {"state": state, "reason": reason, "message": message}
        if state is JobState.running:
            values["started_at"] = func.coalesce(jobs.c.started_at, self.now)
        if not state.is_open:
            values["finished_at"] = self.now
        self.connection.execute(update(jobs).where(jobs.c.seq == job).values(values))
        self._append_event(
            job, EventName.job_state, JobStateEvent(state=state, reason=reason, message=message)
        )

    def complete_job(self, job: int, version: Any, note: str = "") -> None:
        """End a live job, whose dataset version, a row of `dataset_versions`, exists."""
        reference, lost = (
            document_of(DatasetRef, version),
            version.sample_count - version.valid_count,
        )
        rejects = f"{lost} of {version.sample_count} samples were rejected; the dataset lists them with their reasons"
        state = JobState.succeeded_with_rejects if lost else JobState.succeeded
        if self._is_live(job):
            values = {**reference.model_dump(), "rejected_count": lost}
            self.connection.execute(update(jobs).where(jobs.c.seq == job).values(values))
            self._append_event(
                job, EventName.dataset_published, DatasetPublishedEvent(dataset=reference)
            )
            self.end_job(job, state, None, ". ".join(filter(None, [note, rejects if lost else ""])))

    def end_job(self, job: int, state: JobState, reason: Reason | None, message: str) -> None:
        """End a job, unless it is not live any more, and give up what only it needs."""
        if not self._is_live(job):
            return
        self.flush_counters()
        self.set_job_state(job, state, reason=reason, message=message)
        waiting = (job_counts.c.job == job, job_counts.c.state.in_(WAITING), job_counts.c.count > 0)
        if self.connection.scalar(select(job_counts.c.count).where(*waiting).limit(1)):
            release_tasks(self, job)

    def _is_live(self, job: int) -> bool:
        query = select(jobs.c.seq).where(jobs.c.seq == job, jobs.c.state.in_(LIVE))
        return self.connection.scalar(query) is not None

    def open_jobs_of(self, task: int) -> list[int]:
        """Return the open jobs of a task."""
        return [holder.job for holder in self._holders([task]).get(task, ())]

    def flush_counters(self) -> None:
        """Bring the counters up to date."""
        moves, self._moves = self._moves, []
        runs, self._runs = self._runs, []
        if not moves and not runs:
            return
        holders = self._holders({*(task.seq for task, _ in moves), *(task.seq for task, _ in runs)})
        overall, by_job, left = Counter[Any](), Counter[Any](), Counter[Any]()
        for task, new in moves:
            for state, change in ((task.state, -1), (new, 1)):
                overall[task.stage, state] += change
                for holder in holders.get(task.seq, ()):
                    by_job[holder.job, task.stage, state] += change
                    left[holder.job, task.stage, holder.cost_group] += change * (
                        state not in FINISHED
                    )
        TASK_COUNTS.add(self.connection, overall)
        JOB_COUNTS.add(self.connection, by_job)
        JOB_GROUPS.add(self.connection, {group: change for group, change in left.items() if change})
        spent = [
            {
                "b_job": holder.job,
                "b_stage": task.stage,
                "b_cpu": run.cpu_seconds,
                "b_wall": run.wall_seconds,
            }
            for task, run in runs
            for holder in holders.get(task.seq, ())
            if not holder.cached
        ]
        _ADD_TO_JOB_STAGES.run_all(self.connection, spent)
        add_costs(self.connection, runs)

    def _holders(self, task_seqs: Collection[int]) -> dict[int, list[Any]]:
        """Return the open jobs of each task, rows of `_HOLDERS`."""
        found: dict[int, list[Any]] = {}
        for batch in batches(task_seqs):
            for row in _HOLDERS.rows(
                self.connection, {"b_tasks": batch, "b_given_up": list(self.released_jobs)}
            ):
                found.setdefault(row.task, []).append(row)
        return found

    def _append_event(self, job: int, name: EventName, data: Document) -> None:
        row = {"job": job, "name": name, "data": data.model_dump_json(), "created_at": self.now}
        self.connection.execute(insert(events).values(row))


_LIVE_JOBS = Prepared(
    select(
        job_tasks.c.task,
        case((jobs.c.state.in_(RUNNABLE), 0), else_=1),
        jobs.c.priority,
        job_tasks.c.job,
    )
    .join(jobs, jobs.c.seq == job_tasks.c.job)
    .where(
        job_tasks.c.task.in_(bindparam("b_tasks", expanding=True)),
        jobs.c.state.in_(bindparam("b_states", expanding=True)),
    )
)


def live_jobs(
    connection: Connection, task_seqs: Iterable[int], states: Sequence[JobState] = LIVE
) -> dict[int, int]:
    """Return the job to charge each task to, of those in some states.

    Tasks without any are left out.
    """
    found: dict[int, tuple[int, int, int]] = {}
    for batch in batches(task_seqs):
        for task, halted, priority, job in _LIVE_JOBS.tuples(
            connection, {"b_tasks": batch, "b_states": list(states)}
        ):
            mine = (halted, -priority, job)
            found[task] = min(mine, found.get(task, mine))
    return {task: job for task, (_, _, job) in found.items()}


def assign(connection: Connection, job_of: Mapping[int, int]) -> None:
    charges = [{"b_seq": task, "b_job": job} for task, job in job_of.items()]
    if charges:
        own = update(tasks).where(tasks.c.seq == bindparam("b_seq"))
        connection.execute(own.values(job=bindparam("b_job")), charges)


def reassign(tx: QueueTransaction, rows: Sequence[Row]) -> list[Row]:
    """Charge unfinished tasks to the jobs that they will run for.

    Cancel the needless, and return the others.
    """
    job_of = live_jobs(tx.connection, [row.seq for row in rows])
    assign(tx.connection, job_of)
    cancel(tx, [row for row in rows if row.seq not in job_of])
    return [row for row in rows if row.seq in job_of]


def cancel(tx: QueueTransaction, rows: Collection[TaskRow]) -> None:
    """Cancel tasks, leased ones included."""
    tx.set_task_state(rows, TaskState.cancelled, reason=Reason.cancelled, message="no job needs it")


def reassign_waiting(tx: QueueTransaction, job: int) -> None:
    """Reassign the waiting tasks of a job that starts or stops being runnable, or that changes its
    priority.
    """
    kind = select(jobs.c.kind).where(jobs.c.seq == job).scalar_subquery()
    others = select(jobs.c.seq).where(
        jobs.c.seq != job, jobs.c.kind == kind, jobs.c.state.in_(LIVE)
    )
    if (
        tx.connection.scalar(others.limit(1)) is not None
    ):  # otherwise all are charged to this one already
        reassign(tx, _waiting(tx.connection, job_tasks.c.job == job))


def release_tasks(tx: QueueTransaction, job: int, after: int = 0) -> None:
    """Reassign the next `PIECE_TASKS` tasks of a job that is not live any more, and store where to
    go on.
    """
    tx.released_jobs.add(job)
    piece = select(job_tasks.c.task).where(job_tasks.c.job == job, job_tasks.c.task > after)
    seqs = list(tx.connection.scalars(piece.order_by(job_tasks.c.task).limit(RELEASE_BATCH)))
    reassign(tx, _waiting(tx.connection, job_tasks.c.job == job, job_tasks.c.task.in_(seqs)))
    last = seqs[-1] if len(seqs) == RELEASE_BATCH else None
    tx.connection.execute(update(jobs).where(jobs.c.seq == job).values(given_up=last))


def _waiting(connection: Connection, *which: Any) -> Sequence[Any]:
    query = select(*TASK_COLUMNS).join(job_tasks, job_tasks.c.task == tasks.c.seq)
    return connection.execute(query.where(tasks.c.state.in_(WAITING), *which)).all()


@contextmanager
def queue_transaction(connection: Connection, now: float) -> Iterator[QueueTransaction]:
    """Open a ledger and close it, unless the block raises."""
    tx = QueueTransaction(connection, now)
    yield tx
    _close(tx)


def _sum_of(*states: TaskState) -> Any:
    return func.coalesce(func.sum(job_counts.c.count).filter(job_counts.c.state.in_(states)), 0)


_OPEN_JOBS = Prepared(
    select(
        *(jobs.c[name] for name in ("seq", "state", "started_at", "given_up")),
        _sum_of(*ON_LEASE).label("on_lease"),
        _sum_of(TaskState.soft_failed).label("retried"),
        _sum_of(TaskState.failed).label("failed"),
    )
    .outerjoin(job_counts, job_counts.c.job == jobs.c.seq)
    .where(_OPEN)
    .group_by(jobs.c.seq)
)


def _close(tx: QueueTransaction) -> None:
    """Bring the counters up to date, and let the states of the jobs follow."""
    tx.flush_counters()
    for job in _OPEN_JOBS.rows(tx.connection):
        if job.state == JobState.queued and job.on_lease:
            tx.set_job_state(job.seq, JobState.running)
        elif (
            job.state == JobState.planning and job.on_lease and job.started_at is None
        ):  # it runs when it is planned
            tx.connection.execute(
                update(jobs).where(jobs.c.seq == job.seq).values(started_at=tx.now)
            )
        elif (
            job.state in (JobState.queued, JobState.running)
            and job.failed
            and not (job.on_lease or job.retried)
        ):
            _end_if_blocked(tx, job.seq)
        elif job.state == JobState.pausing and not (
            job.on_lease and has_exclusive_lease(tx.connection, job.seq, RUNNABLE)
        ):
            why = tx.connection.execute(
                select(jobs.c.reason, jobs.c.message).where(jobs.c.seq == job.seq)
            ).one()
            message = why.message if why.reason else "paused; resume it to go on"
            tx.set_job_state(job.seq, JobState.paused, reason=why.reason, message=message)
        elif job.state == JobState.cancelling and not (
            job.given_up or (job.on_lease and has_exclusive_lease(tx.connection, job.seq, LIVE))
        ):
            message = "cancelled; what had been finished is kept and will not be done again"
            tx.set_job_state(job.seq, JobState.cancelled, reason=Reason.cancelled, message=message)
    tx.flush_counters()


def has_exclusive_lease(connection: Connection, job: int, states: Sequence[JobState]) -> bool:
    """Return whether a job has a task on lease that no job in some states needs."""
    # Looked for among all tasks on lease, which are fewer than a job has.
    is_of_job = exists().where(job_tasks.c.job == job, job_tasks.c.task == tasks.c.seq)
    held = set(connection.scalars(select(tasks.c.seq).where(IS_LEASED, is_of_job)))
    return bool(held - live_jobs(connection, held, states).keys())


def _end_if_blocked(tx: QueueTransaction, job: int) -> None:
    """End a job with quarantined tasks of which nothing runs, unless one can be leased."""
    own = select(*TASK_COLUMNS, tasks.c.key, tasks.c.message).join(
        job_tasks, job_tasks.c.task == tasks.c.seq
    )
    own = own.where(job_tasks.c.job == job)
    if tx.connection.execute(own.where(IS_READY).limit(1)).first() is not None:
        return
    failed = tx.connection.execute(
        own.where(tasks.c.state == TaskState.failed).order_by(tasks.c.seq)
    ).all()
    message = (
        f"everything else is done, but {len(failed)} of its tasks were quarantined; the first is "
        f"{task_id(failed[0].stage, failed[0].key)}: {failed[0].message}. What is done is kept; submit the job again "
        "to try again"
    )
    tx.end_job(job, JobState.failed, Reason.quarantined, message)
