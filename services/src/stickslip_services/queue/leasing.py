"""Leases: who may run which task, and until when.

A lease is (worker, token); the token of a task increments at each lease, so that a worker that lost its lease is told
from the one that has it. The next task goes to the project that has the fewest tasks on lease; of its jobs, to the one
of the highest priority, and of those to the one that has the fewest tasks on lease: a small job does not wait behind a
big one, jobs of one size share evenly, and no project can take all workers by its priorities or its number of jobs.
Within a job and stage the order is that of the slots, so that shards fill up one after the other. How many tasks of
each stage run is the dispatcher's choice.
"""

import heapq
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import Connection, bindparam, func, select, text, update
from stickslip_schemas import tracing
from stickslip_schemas.base.states import Stage, TaskState
from stickslip_schemas.documents.worker_api import Lease, LeaseState

from stickslip_services.database.database import batches
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_counts, jobs, tasks
from stickslip_services.queue.compose import Publish, StoredTask, compose_tasks, reserve_version
from stickslip_services.queue.costs import limit_seconds, long_groups, read_costs
from stickslip_services.queue.eta import Cost, Group
from stickslip_services.queue.ids import task_id, task_key
from stickslip_services.queue.ledger import (
    LIVE,
    RUNNABLE,
    HeldTask,
    Ledger,
    cancel_tasks,
    live_jobs,
    release,
    runnable_tasks,
    start_tasks,
)
from stickslip_services.queue.workers import RegisteredWorker
from stickslip_services.settings import Settings

_READY = text("tasks.state = 'pending' AND tasks.waiting_on = 0")  # in the words of the partial index


@dataclass(frozen=True, slots=True)
class _Ready:
    seq: int
    job: int
    key: bytes
    stage: Stage
    kind: str
    cost_group: str
    tries: int
    payload: str
    preview: bool
    token: int
    attempts: int


_OF_GROUP = (
    _READY,
    tasks.c.stage == bindparam("b_stage"),
    tasks.c.build == bindparam("b_build"),
    tasks.c.kind == bindparam("b_kind"),
    tasks.c.cost_group.not_in(bindparam("b_left_out", expanding=True)),
)
_READY_TASK = Prepared(
    select(tasks.c.seq)
    .where(*_OF_GROUP, tasks.c.job.in_(select(jobs.c.seq).where(jobs.c.state.in_(RUNNABLE))))
    .limit(1)
)
_READY_TASKS = Prepared(
    select(
        *(tasks.c[name] for name in ("seq", "key", "payload", "preview", "token", "attempts", "cost_group", "tries"))
    )
    .where(*_OF_GROUP, tasks.c.job == bindparam("b_job"))
    .order_by(tasks.c.seq)
    .limit(bindparam("b_count"))
)
_JOBS_WITH_PENDING = Prepared(
    select(
        job_counts.c.job,
        jobs.c.project,
        jobs.c.priority,
        func.coalesce(
            func.sum(job_counts.c.count).filter(job_counts.c.state.in_((TaskState.leased, TaskState.running))), 0
        ),
    )
    .join(jobs, jobs.c.seq == job_counts.c.job)
    .where(jobs.c.state.in_(RUNNABLE), job_counts.c.stage == bindparam("b_stage"))
    .group_by(job_counts.c.job, jobs.c.project, jobs.c.priority)
    .having(func.sum(job_counts.c.count).filter(job_counts.c.state == TaskState.pending) > 0)
)
_ON_LEASE = Prepared(
    select(jobs.c.project, func.sum(job_counts.c.count))
    .join(jobs, jobs.c.seq == job_counts.c.job)
    .where(
        jobs.c.state.in_(LIVE),
        job_counts.c.stage == bindparam("b_stage"),
        job_counts.c.state.in_((TaskState.leased, TaskState.running)),
    )
    .group_by(jobs.c.project)
)
_LEASE = Prepared(
    update(tasks)
    .where(tasks.c.seq == bindparam("b_seq"))
    .values(
        state=TaskState.leased,
        token=bindparam("b_token"),
        owner=bindparam("b_owner"),
        expires_at=bindparam("b_expires_at"),
    )
)


def has_ready_task(
    connection: Connection, worker: RegisteredWorker, stages: Iterable[Stage], *, at_most: float | None
) -> bool:
    """Tell whether a lease request of these stages would be granted anything; `at_most` seconds a call."""
    costs = {} if at_most is None else read_costs(connection)
    return any(
        _READY_TASK.scalar(
            connection,
            {
                "b_stage": stage,
                "b_build": build,
                "b_kind": kind,
                "b_left_out": long_groups(costs, stage, kind, at_most),
            },
        )
        for kind in worker.kinds
        for stage, build in worker.stage_builds(kind).items()
        if stage in stages
    )


@dataclass(frozen=True, slots=True)
class Grant:
    """A task that has been leased and is still to be composed."""

    task: StoredTask
    job: int
    task_id: str
    token: int
    attempt: int
    limit_seconds: float | None


def grant_leases(
    book: Ledger, worker: RegisteredWorker, wanted: dict[Stage, int], settings: Settings, *, at_most: float | None
) -> list[Grant]:
    """Lease up to the wanted number of tasks of each stage to `worker`; none known to take over `at_most` seconds."""
    granted: list[_Ready] = []
    costs = read_costs(book.connection)
    for stage in reversed(Stage):  # what is nearest to a dataset first
        count = min(wanted.get(stage, 0), settings.lease_limit)
        if count > 0:
            granted.extend(_pick(book.connection, worker, stage, count, costs, at_most))
    if not granted:
        return []
    for task in granted:
        book.moved(task.seq, task.stage, TaskState.pending, TaskState.leased)
    lease = {"b_owner": worker.id, "b_expires_at": book.now + settings.lease_seconds}
    _LEASE.run_all(book.connection, [{"b_seq": task.seq, "b_token": task.token + 1, **lease} for task in granted])
    grants = [
        Grant(
            task=StoredTask(task.seq, task.stage, task.payload, task.preview),
            job=task.job,
            task_id=task_id(task.stage, task.key),
            token=task.token + 1,
            attempt=task.attempts + 1,
            limit_seconds=limit_seconds(
                costs.get((task.stage, task.kind, task.cost_group)), task.tries, floor=settings.limit_floor_seconds
            ),
        )
        for task in granted
    ]
    for grant in grants:
        if grant.task.stage is Stage.publish:
            reserve_version(book.connection, grant.task)
    return grants


def compose_leases(connection: Connection, grants: Sequence[Grant], publish: Publish) -> tuple[Lease, ...]:
    """Return what the worker is told of the tasks that it has been granted; see `compose_tasks`."""
    composed = compose_tasks(connection, [grant.task for grant in grants], publish)
    traceparents = _traceparents_of(connection, {grant.job for grant in grants}) if tracing.is_on() else {}
    return tuple(
        Lease(
            task_id=grant.task_id,
            token=grant.token,
            attempt=grant.attempt,
            limit_seconds=grant.limit_seconds,
            traceparent=traceparents.get(grant.job),
            task=composed[grant.task.seq],
        )
        for grant in grants
    )


def _pick(
    connection: Connection,
    worker: RegisteredWorker,
    stage: Stage,
    count: int,
    costs: Mapping[Group, Cost],
    at_most: float | None,
) -> list[_Ready]:
    """Choose ready tasks of a stage, one at a time; see the module for which comes next."""
    queues: dict[str, list[_Waiting]] = {}
    for job, project, priority, on_lease in _jobs_with_pending(connection, stage):
        ready = [
            task
            for kind in worker.kinds
            for task in _ready_tasks(
                connection, worker, stage, kind, job, count, long_groups(costs, stage, kind, at_most)
            )
        ]
        if ready:
            queues.setdefault(project, []).append((-priority, on_lease, job, ready[::-1]))
    for queue in queues.values():
        heapq.heapify(queue)
    on_lease_of = dict(_ON_LEASE.tuples(connection, {"b_stage": stage})) if len(queues) > 1 else {}
    projects = [(on_lease_of.get(name, 0), name) for name in queues]
    heapq.heapify(projects)
    picked: list[_Ready] = []
    while projects and len(picked) < count:
        on_lease, name = projects[0]
        picked.append(_pop(queues[name]))
        if queues[name]:
            heapq.heapreplace(projects, (on_lease + 1, name))
        else:
            heapq.heappop(projects)
    return picked


_Waiting = tuple[int, int, int, list[_Ready]]
"""-priority, tasks on lease, job, its ready tasks in reverse order."""


def _pop(queue: list[_Waiting]) -> _Ready:
    """Take the next task from the jobs of a project."""
    order, on_lease, job, ready = queue[0]
    task = ready.pop()
    if ready:
        heapq.heapreplace(queue, (order, on_lease + 1, job, ready))
    else:
        heapq.heappop(queue)
    return task


def _jobs_with_pending(connection: Connection, stage: Stage) -> Sequence[tuple[int, str, int, int]]:
    """Return (job, project, priority, tasks of the stage on lease) of the runnable jobs that wait for such tasks."""
    return _JOBS_WITH_PENDING.tuples(connection, {"b_stage": stage})


def _ready_tasks(
    connection: Connection,
    worker: RegisteredWorker,
    stage: Stage,
    kind: str,
    job: int,
    count: int,
    left_out: Sequence[str],
) -> list[_Ready]:
    rows = _READY_TASKS.rows(
        connection,
        {
            "b_stage": stage,
            "b_build": worker.stage_builds(kind)[stage],
            "b_kind": kind,
            "b_left_out": left_out,
            "b_job": job,
            "b_count": count,
        },
    )
    return [
        _Ready(
            seq=row.seq,
            job=job,
            key=row.key,
            stage=stage,
            kind=kind,
            cost_group=row.cost_group,
            tries=row.tries,
            payload=row.payload,
            preview=bool(row.preview),
            token=row.token,
            attempts=row.attempts,
        )
        for row in rows
    ]


def renew_leases(
    book: Ledger, worker: RegisteredWorker, held: Sequence[LeaseState], settings: Settings
) -> tuple[str, ...]:
    """Renew leases, note which tasks have been started, and return the tasks that the worker has to drop."""
    drop: list[str] = []
    mine: list[tuple[LeaseState, HeldTask]] = []
    keys = {state.task_id: task_key(state.task_id) for state in held}
    names = ("key", "seq", "stage", "state", "tries", "losses", "token", "owner")
    columns = [tasks.c[name] for name in names]
    rows = {
        row.key: row
        for batch in batches(key for key in keys.values() if key is not None)
        for row in book.connection.execute(select(*columns).where(tasks.c.key.in_(batch)))
    }
    for lease in held:
        row = rows.get(keys[lease.task_id] or b"")
        if row is None or row.owner != worker.id or row.token != lease.token or worker.superseded:
            drop.append(lease.task_id)
        else:
            mine.append(
                (lease, HeldTask(row.seq, row.key, Stage(row.stage), TaskState(row.state), row.tries, row.losses))
            )
    unneeded = _unneeded(book, mine)
    cancel_tasks(book, [(task.seq, task.stage, task.state) for _, task in mine if task.seq in unneeded])
    halted = _halted(book, [(lease, task) for lease, task in mine if task.seq not in unneeded])
    for _, task in mine:
        if task.seq in halted:
            release(book, task, TaskState.pending)
    drop.extend(lease.task_id for lease, task in mine if task.seq in unneeded | halted)
    kept = [(lease, task) for lease, task in mine if task.seq not in unneeded | halted]
    for batch in batches(kept):
        book.connection.execute(
            update(tasks)
            .where(tasks.c.seq.in_([task.seq for _, task in batch]))
            .values(expires_at=book.now + settings.lease_seconds)
        )
    started = [task for lease, task in kept if lease.started and task.state is TaskState.leased]
    start_tasks(book, [(task.seq, task.stage) for task in started])
    return tuple(drop)


def renew_all_leases(connection: Connection, now: float, settings: Settings) -> None:
    """Give every lease its full time again: while the coordinator was down, no heartbeat could arrive."""
    connection.execute(
        update(tasks).where(text("tasks.owner IS NOT NULL")).values(expires_at=now + settings.lease_seconds)
    )


def _unneeded(book: Ledger, held: Sequence[tuple[LeaseState, HeldTask]]) -> set[int]:
    """Return the tasks to cancel: those of jobs being cancelled, and of ended jobs those that have not been started.

    What a failed job had already started is left to finish: it is paid for, and kept for the next time.
    """
    seqs = [task.seq for _, task in held]
    needed = live_jobs(book.connection, seqs)
    cancelling = book.holders(seq for seq in seqs if seq not in needed)
    return {
        task.seq
        for lease, task in held
        if task.seq not in needed and (task.seq in cancelling or not _is_started(lease, task))
    }


def _halted(book: Ledger, held: Sequence[tuple[LeaseState, HeldTask]]) -> set[int]:
    """Return the tasks to give back: those that only paused jobs need and that have not been started."""
    waiting = {task.seq for lease, task in held if not _is_started(lease, task)}
    return live_jobs(book.connection, waiting).keys() - runnable_tasks(book.connection, waiting)


def _is_started(lease: LeaseState, task: HeldTask) -> bool:
    return lease.started or task.state is TaskState.running


def _traceparents_of(connection: Connection, job_seqs: Iterable[int]) -> dict[int, str]:
    """Return the traceparents of the jobs that have one, by `seq`."""
    rows = connection.execute(select(jobs.c.seq, jobs.c.traceparent).where(jobs.c.seq.in_(job_seqs)))
    return {seq: traceparent for seq, traceparent in rows if traceparent is not None}
