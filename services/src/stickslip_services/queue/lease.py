"""Leases: workers register, lease tasks, and renew their leases.

A lease is (worker, token). The token of a task increments with each lease (fencing), so that a message of a worker that
has lost its lease is recognised.
"""

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, bindparam, select, update
from stickslip_schemas.base import JobState, Reason, TaskState
from stickslip_schemas.documents.tasks import PublishTask
from stickslip_schemas.documents.worker_api import (
    Heartbeat,
    HeartbeatAnswer,
    Lease,
    LeaseBatch,
    LeaseRequest,
    LeaseState,
    WorkerRegistration,
    WorkerSession,
)

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_tasks, jobs, tasks, workers
from stickslip_services.errors import ConflictError, DamagedRowsError
from stickslip_services.queue.compose import UNSOUND, Publish, compose_task
from stickslip_services.queue.context import Context
from stickslip_services.queue.grants import grant_leases, has_ready_task
from stickslip_services.queue.ids import task_key
from stickslip_services.queue.jobs import has_runnable_job
from stickslip_services.queue.ledger import HELD, RUNNABLE, Ledger, cancel, live_jobs
from stickslip_services.queue.planner import plan_waiting_jobs
from stickslip_services.queue.recompute import mend
from stickslip_services.queue.retries import fail_tries, find_held, is_sweep_due, lose, take_back
from stickslip_services.queue.workers import (
    RegisteredWorker,
    find_worker,
    insert_worker,
    note_heard,
    note_seen,
    note_stranded,
)

BUSY_POLL_SECONDS = 0.2
IDLE_POLL_SECONDS = 1.0


def register_worker(context: Context, registration: WorkerRegistration) -> WorkerSession:
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
    return WorkerSession(worker_id=worker.id, lease_seconds=context.settings.lease_seconds)


def lease_tasks(context: Context, request: LeaseRequest) -> LeaseBatch:
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
        return LeaseBatch(leases=(), retry_after_seconds=IDLE_POLL_SECONDS)
    if not (ready or due):
        return LeaseBatch(leases=(), retry_after_seconds=BUSY_POLL_SECONDS if waiting else IDLE_POLL_SECONDS)
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
    return LeaseBatch(leases=leases, retry_after_seconds=0 if leases else BUSY_POLL_SECONDS)


def renew_leases(context: Context, messages: Sequence[Heartbeat]) -> list[list[LeaseState] | None]:
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
    found: list[list[LeaseState] | None] = []
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


def sort_out(context: Context, message: Heartbeat, left: Sequence[LeaseState]) -> HeartbeatAnswer:
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
    return HeartbeatAnswer(drop=tuple(drop))


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
) -> tuple[tuple[Lease, ...], dict[int, Sequence[int]]]:
    """Return the leases of granted tasks, and by task the damaged results where rows that it needs are damaged."""
    leases: list[Lease] = []
    damaged: dict[int, Sequence[int]] = {}
    for task, terms in grants:
        try:
            leases.append(Lease(task=compose_task(connection, task, publish), **terms))
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


def renew_all_leases(connection: Connection, now: float, lease_seconds: float) -> None:
    """Renew every lease: while the coordinator was down, no heartbeat could arrive."""
    connection.execute(update(tasks).where(HELD).values(expires_at=now + lease_seconds))
    ahead = workers.c.last_seen_at > now  # by the clock of an earlier process
    connection.execute(update(workers).where(ahead).values(last_seen_at=now))


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
