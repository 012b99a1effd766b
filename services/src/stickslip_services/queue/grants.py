"""Which tasks are leased next: fair shares of projects and jobs.

The next task is that of the project with the fewest tasks on lease; of its jobs, of the one with the highest priority,
and of those, of the one with the fewest tasks on lease. So a small job does not wait behind a big one, jobs of equal
priority share evenly, and no project can occupy all workers by its priorities or its number of jobs. Within a job and
stage the order is that of the slots, so that shards fill up one after the other. The dispatcher chooses how many tasks
of each stage it runs.
"""

import heapq
from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import Connection, bindparam, func, select, update
from stickslip_schemas.base import Stage, TaskState

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_counts, jobs, tasks
from stickslip_services.queue.compose import STORED_TASK, reserve_version
from stickslip_services.queue.eta import Cost, Group, limit_seconds, long_groups, read_costs
from stickslip_services.queue.ids import task_id
from stickslip_services.queue.ledger import LIVE, ON_LEASE, READY, RUNNABLE, Ledger
from stickslip_services.queue.workers import RegisteredWorker
from stickslip_services.settings import Settings

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
