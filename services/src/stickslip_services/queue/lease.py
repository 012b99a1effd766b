"""Leases: workers register, lease tasks, and renew their leases.

A lease is (worker, token). The token of a task increments with each lease (fencing), so that a message of a worker that
has lost its lease is recognised.

The next task is that of the project with the fewest tasks on lease; of its jobs, of the one with the highest priority,
and of those, of the one with the fewest tasks on lease. So a small job does not wait behind a big one, jobs of equal
priority share evenly, and no project can occupy all workers by its priorities or its number of jobs. Within a job and
stage the order is that of the slots, so that shards fill up one after the other. The dispatcher chooses how many tasks
of each stage it runs.
"""

import heapq
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, bindparam, func, select, update
from stickslip_schemas.base import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents import worker_api
from stickslip_schemas.documents.tasks import PublishTask

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_counts, job_tasks, jobs, tasks, workers
from stickslip_services.errors import ConflictError, DamagedRowsError
from stickslip_services.queue.compose import STORED_TASK, UNSOUND, Publish, compose_task, reserve_version
from stickslip_services.queue.context import Context
from stickslip_services.queue.eta import Cost, Group, limit_seconds, long_groups, read_costs
from stickslip_services.queue.ids import task_id, task_key
from stickslip_services.queue.jobs import has_runnable_job
from stickslip_services.queue.ledger import HELD, LIVE, ON_LEASE, READY, RUNNABLE, Ledger, cancel, live_jobs
from stickslip_services.queue.recompute import mend
from stickslip_services.queue.report import fail_tries, find_held, is_sweep_due, lose, take_back
from stickslip_services.queue.submit import plan_waiting_jobs
from stickslip_services.queue.workers import (
    RegisteredWorker,
    find_worker,
    insert_worker,
    note_heard,
    note_seen,
    note_stranded,
)
from stickslip_services.settings import Settings

BUSY_POLL_SECONDS = 0.2
IDLE_POLL_SECONDS = 1.0


def register_worker(context: Context, registration: worker_api.WorkerRegistration) -> worker_api.WorkerSession:
    """Register a worker; an earlier session of the name loses its leases."""
    with context.ledger() as book:
        old = list(book.connection.scalars(select(workers.c.id).where(workers.c.name == registration.name)))
        worker = insert_worker(book.connection, registration, book.now)
        message = f"worker {registration.name} was started anew"
        lose(book, find_held(book.connection, old), context.settings, message=message)
    for earlier in old:
        context.frames_by_worker.pop(earlier, None)
    plan_waiting_jobs(context)
    note_stranded(context)
    return worker_api.WorkerSession(worker_id=worker.id, lease_seconds=context.settings.lease_seconds)


def lease_tasks(context: Context, request: worker_api.LeaseRequest) -> worker_api.LeaseBatch:
    """Lease tasks to a worker; raise UnknownWorkerError, or ConflictError for a superseded session."""
    wanted = {stage: count for stage, count in request.wanted.items() if count > 0}
    with context.database.read() as connection:
        worker = _unsuperseded(connection, request.worker_id)
        due = is_sweep_due(connection, context.clock(), context.alive_since)
        ready = has_ready_task(connection, worker, wanted.keys(), at_most=request.at_most_seconds)
        waiting = ready or has_runnable_job(connection)
    if due:
        take_back(context)
    if context.store_watch.trouble:
        return worker_api.LeaseBatch(leases=(), retry_after_seconds=IDLE_POLL_SECONDS)
    if not (ready or due):
        return worker_api.LeaseBatch(leases=(), retry_after_seconds=BUSY_POLL_SECONDS if waiting else IDLE_POLL_SECONDS)
    with context.ledger() as book:
        worker = _unsuperseded(book.connection, worker.id)
        note_heard(book.connection, [worker.id], book.now)
        grants = grant_leases(book, worker, wanted, context.settings, at_most=request.at_most_seconds)
    # The dependencies of these tasks have ended, so composing them needs no write transaction.
    with context.database.read() as connection:
        leases, damaged = _compose_leases(connection, grants, context.store.publish)
    if damaged:
        _mend(context, worker.id, damaged)
    context.sections |= {lease.task_id: lease.task.sections for lease in leases if isinstance(lease.task, PublishTask)}
    return worker_api.LeaseBatch(leases=leases, retry_after_seconds=0 if leases else BUSY_POLL_SECONDS)


def renew_leases(
    context: Context, messages: Sequence[worker_api.Heartbeat]
) -> list[list[worker_api.LeaseState] | None]:
    """Renew the leases of workers, with two statements for all; return what `sort_out` must look at, None for nothing.

    The time of a worker's last message, also a report, renews all its leases.
    """
    now, ids = context.clock(), [message.worker_id for message in messages]
    held: dict[str, dict[tuple[str, int], Sequence[Any]]] = {worker: {} for worker in ids}
    is_news = False
    with context.database.touch() as connection:
        known = note_heard(connection, ids, now)
        for worker, key, token, *state in _HELD.tuples(connection, {"b_workers": ids}):
            held[worker][key.hex(), token] = state
        for message in messages:
            before = known.get(message.worker_id, message.condition)
            if message.condition != before:
                note_seen(connection, message.worker_id, now, message.condition)
                is_news |= message.condition.state != before.state
    if is_news:
        note_stranded(context)
    found: list[list[worker_api.LeaseState] | None] = []
    for message in messages:
        mine, left, listed = held[message.worker_id], [], set()
        for lease in message.leases:
            name = lease.task_id.rpartition("-")[2], lease.token
            state, _, runnable_job = mine.get(name, _GONE)
            if runnable_job is None or state not in _GOES_ON[lease.started]:
                left.append(lease)
            listed.add(name)
        lost = any(expires_at <= now and name not in listed for name, (_, expires_at, _) in mine.items())
        is_known = message.worker_id in known
        found.append(left if left or lost or not is_known else None)
        if is_known:
            frames = {lease.task_id: lease.frames for lease in message.leases if lease.frames is not None}
            context.frames_by_worker[message.worker_id] = frames
    return found


def sort_out(
    context: Context, message: worker_api.Heartbeat, left: Sequence[worker_api.LeaseState]
) -> worker_api.HeartbeatAnswer:
    """Note which tasks of a heartbeat have been started, and return those to drop; raise UnknownWorkerError.

    A lease that has had its duration, and that the message does not list, is taken back: its answer was lost.
    """
    with context.ledger() as book:
        worker = find_worker(book.connection, message.worker_id)
        note_seen(book.connection, worker.id, book.now, message.condition)
        held = {(task.key, task.token): task for task in find_held(book.connection, [worker.id])}
        names = [(lease, (task_key(lease.task_id), lease.token)) for lease in left]
        has_started = {name: lease.started for lease, name in names if name in held}
        started = {held[name].seq for name, yes in has_started.items() if yes or held[name].state == TaskState.running}
        dropped = _drop(book, [held[name] for name in has_started], started)
        fresh = [held[name] for name, yes in has_started.items() if yes and held[name].state == TaskState.leased]
        book.start([task for task in fresh if task.seq not in dropped])
        listed = {task_key(lease.task_id) for lease in message.leases}
        unlisted = [task for task in held.values() if task.key not in listed and task.expires_at <= book.now]
        lose(book, unlisted, context.settings, message=f"worker {worker.name} does not know of it")
    drop = [lease.task_id for lease, name in names if name not in held or held[name].seq in dropped]
    return worker_api.HeartbeatAnswer(drop=tuple(drop))


_RUNNABLE_JOB = (
    select(jobs.c.seq)
    .join(job_tasks, job_tasks.c.job == jobs.c.seq)
    .where(job_tasks.c.task == tasks.c.seq, jobs.c.state.in_(RUNNABLE))
    .limit(1)
    .scalar_subquery()
    .label("runnable_job")
)
_HELD = Prepared(
    select(tasks.c.owner, tasks.c.key, tasks.c.token, tasks.c.state, tasks.c.expires_at, _RUNNABLE_JOB).where(
        HELD, tasks.c.owner.in_(bindparam("b_workers", expanding=True))
    )
)
_GONE = None, None, None
_GOES_ON = {False: (TaskState.leased, TaskState.running), True: (TaskState.running,)}
"""States of tasks that need no change, by whether the worker says that they have been started."""


def _unsuperseded(connection: Connection, worker_id: str) -> RegisteredWorker:
    worker = find_worker(connection, worker_id)
    if worker.superseded:
        raise ConflictError(f"another session of worker {worker.name} has registered; this one gets no tasks")
    return worker


def _compose_leases(
    connection: Connection, grants: Sequence[tuple[Any, dict[str, Any]]], publish: Publish
) -> tuple[tuple[worker_api.Lease, ...], dict[int, Sequence[int]]]:
    """Return the leases of granted tasks, and by task the damaged results where rows that it needs are damaged."""
    leases: list[worker_api.Lease] = []
    damaged: dict[int, Sequence[int]] = {}
    for task, terms in grants:
        try:
            leases.append(worker_api.Lease(task=compose_task(connection, task, publish), **terms))
        except UNSOUND as error:
            damaged[task.seq] = getattr(error, "results", ())
    return tuple(leases), damaged


def _mend(context: Context, worker_id: str, damaged: dict[int, Sequence[int]]) -> None:
    """Mend the rows that leased tasks need, and retry these, as after a report of damaged artifacts."""
    with context.ledger() as book:
        held = [task for task in find_held(book.connection, [worker_id]) if task.seq in damaged]
        book.start(held)
        why = Reason.storage_error, str(DamagedRowsError())
        fail_tries(book, [(task._replace(state=TaskState.running), *why) for task in held], context.settings)
        for task in held:
            mend(book, task.seq, damaged[task.seq])


def _drop(book: Ledger, held: Sequence[Any], started: set[int]) -> set[int]:
    """Cancel or give back leased tasks that the worker is to drop; return them.

    Dropped are those of `cancelling` jobs and, unless they are `started`, those of ended and of paused jobs. What a
    failed job has started finishes, and its results are kept for the next submission.
    """
    seqs = [task.seq for task in held]
    needed, running = live_jobs(book.connection, seqs), live_jobs(book.connection, seqs, RUNNABLE)
    left = [task for task in held if task.seq not in needed]
    cancelling = live_jobs(book.connection, [task.seq for task in left], (JobState.cancelling,))
    unneeded = [task for task in left if task.seq in cancelling or task.seq not in started]
    halted = [task for task in held if task.seq in needed and task.seq not in started | running.keys()]
    cancel(book, unneeded)
    book.move(halted, TaskState.pending)
    return {task.seq for task in (*unneeded, *halted)}


_OF_GROUP = (
    READY,
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
    select(*STORED_TASK, *(tasks.c[name] for name in ("kind", "cost_group", "tries", "token", "attempts")))
    .where(*_OF_GROUP, tasks.c.job == bindparam("b_job"))
    .order_by(tasks.c.seq)
    .limit(bindparam("b_count"))
)
_JOBS_WITH_PENDING = Prepared(
    select(
        job_counts.c.job,
        jobs.c.project,
        jobs.c.priority,
        func.coalesce(func.sum(job_counts.c.count).filter(job_counts.c.state.in_(ON_LEASE)), 0),
    )
    .join(jobs, jobs.c.seq == job_counts.c.job)
    .where(jobs.c.state.in_(RUNNABLE), job_counts.c.stage == bindparam("b_stage"))
    .group_by(job_counts.c.job, jobs.c.project, jobs.c.priority)
    .having(func.sum(job_counts.c.count).filter(job_counts.c.state == TaskState.pending) > 0)
)
_ON_LEASE = Prepared(
    select(jobs.c.project, func.sum(job_counts.c.count))
    .join(jobs, jobs.c.seq == job_counts.c.job)
    .where(jobs.c.state.in_(LIVE), job_counts.c.stage == bindparam("b_stage"), job_counts.c.state.in_(ON_LEASE))
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
    """Return whether a request for these stages would be granted a task of at most `at_most` seconds a call."""
    costs = {} if at_most is None else read_costs(connection)
    return any(
        _READY_TASK.scalar(connection, _group(costs, stage, kind, build, at_most))
        for kind, builds in worker.builds.items()
        for stage, build in builds.by_stage.items()
        if stage in stages
    )


def _group(costs: Mapping[Group, Cost], stage: Stage, kind: str, build: str, at_most: float | None) -> dict[str, Any]:
    """Return the parameters of `_OF_GROUP`."""
    left_out = long_groups(costs, stage, kind, at_most)
    return {"b_stage": stage, "b_build": build, "b_kind": kind, "b_left_out": left_out}


def grant_leases(
    book: Ledger, worker: RegisteredWorker, wanted: dict[Stage, int], settings: Settings, *, at_most: float | None
) -> list[tuple[Any, dict[str, Any]]]:
    """Lease up to the wanted number of tasks of each stage to `worker`; none known to take over `at_most` seconds.

    Return the tasks (see `STORED_TASK`), each with the other fields of its `Lease`.
    """
    granted: list[Any] = []
    costs = read_costs(book.connection)
    for stage in reversed(Stage):  # what is nearest to a dataset first
        count = min(wanted.get(stage, 0), settings.lease_limit)
        if count > 0:
            granted.extend(_pick(book.connection, worker, stage, count, costs, at_most))
    lease = {"b_owner": worker.id, "b_expires_at": book.now + settings.lease_seconds}
    _LEASE.run_all(book.connection, [{"b_seq": row.seq, "b_token": row.token + 1, **lease} for row in granted])
    book.moved(granted, TaskState.leased)
    grants = []
    for row in granted:
        cost = costs.get((row.stage, row.kind, row.cost_group))
        limit = limit_seconds(cost, row.tries, floor=settings.limit_floor_seconds)
        terms = {"token": row.token + 1, "attempt": row.attempts + 1, "limit_seconds": limit}
        grants.append((row, terms | {"task_id": task_id(row.stage, row.key)}))
        if row.stage == Stage.publish:
            reserve_version(book.connection, row)
    return grants


def _pick(
    connection: Connection,
    worker: RegisteredWorker,
    stage: Stage,
    count: int,
    costs: Mapping[Group, Cost],
    at_most: float | None,
) -> list[Any]:
    """Choose ready tasks of a stage (rows of `_READY_TASKS`), one at a time, in the order that the module describes."""
    queues: dict[str, list[_Waiting]] = {}
    for job, project, priority, on_lease in _JOBS_WITH_PENDING.tuples(connection, {"b_stage": stage}):
        ready: list[Any] = []
        for kind, builds in worker.builds.items():
            group = _group(costs, stage, kind, builds.by_stage[stage], at_most)
            ready += _READY_TASKS.rows(connection, group | {"b_job": job, "b_count": count})
        if ready:
            queues.setdefault(project, []).append((-priority, on_lease, job, ready[::-1]))
    for queue in queues.values():
        heapq.heapify(queue)
    on_lease_of = dict(_ON_LEASE.tuples(connection, {"b_stage": stage})) if len(queues) > 1 else {}
    projects = [(on_lease_of.get(name, 0), name) for name in queues]
    heapq.heapify(projects)
    picked: list[Any] = []
    while projects and len(picked) < count:
        on_lease, name = projects[0]
        picked.append(_pop(queues[name]))
        if queues[name]:
            heapq.heapreplace(projects, (on_lease + 1, name))
        else:
            heapq.heappop(projects)
    return picked


_Waiting = tuple[int, int, int, list[Any]]
"""-priority, tasks on lease, job, its ready tasks in reverse order."""


def _pop(queue: list[_Waiting]) -> Any:
    """Take the next task from the jobs of a project."""
    order, on_lease, job, ready = queue[0]
    task = ready.pop()
    if ready:
        heapq.heapreplace(queue, (order, on_lease + 1, job, ready))
    else:
        heapq.heappop(queue)
    return task
