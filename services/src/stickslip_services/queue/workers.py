"""Workers: registered dispatchers, what they can run, and jobs that no connected worker can run."""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any

from sqlalchemy import Connection, bindparam, insert, select, update
from stickslip_schemas.base import JobState, Reason, Stage
from stickslip_schemas.documents import responses
from stickslip_schemas.documents.worker_api import WorkerCondition, WorkerRegistration
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.costs import MachineSpeed

from stickslip_services.access.principals import is_visible_project
from stickslip_services.database.database import Prepared, as_datetime, document_of
from stickslip_services.database.tables import jobs, tasks, workers
from stickslip_services.errors import KindNotAvailableError, UnknownWorkerError
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import new_id, task_id
from stickslip_services.queue.transaction import IS_LEASED, RUNNABLE

NO_WORKER = (
    "no worker has told its builds yet; the job is planned when one does (see the workers page)"
)


@dataclass(frozen=True, slots=True)
class RegisteredWorker:
    id: str
    name: str
    builds: Mapping[str, Builds]
    """Builds by kind."""
    condition: WorkerCondition
    versions: dict[str, str]
    registered_at: float
    last_seen_at: float
    superseded: bool


def insert_worker(
    connection: Connection, registration: WorkerRegistration, now: float
) -> RegisteredWorker:
    """Insert a registration; earlier sessions of the name are superseded."""
    connection.execute(
        update(workers).where(workers.c.name == registration.name).values(superseded=True)
    )
    worker_id = new_id("worker")
    connection.execute(
        insert(workers).values(
            id=worker_id,
            name=registration.name,
            builds=json.dumps(
                {kind: builds.model_dump() for kind, builds in registration.builds.items()}
            ),
            condition=registration.condition.model_dump_json(),
            versions=json.dumps(registration.versions),
            registered_at=now,
            last_seen_at=now,
            superseded=False,
        )
    )
    return find_worker(connection, worker_id)


_WORKER = Prepared(select(workers).where(workers.c.id == bindparam("b_id")))


def find_worker(connection: Connection, worker_id: str) -> RegisteredWorker:
    """Return a worker, superseded or not; raise UnknownWorkerError."""
    rows = _WORKER.rows(connection, {"b_id": worker_id})
    if not rows:
        raise UnknownWorkerError(f"no worker has the id {worker_id!r}: register again")
    return _worker(rows[0])


_PRESENT_WORKERS = Prepared(
    select(workers)
    .where(~workers.c.superseded, workers.c.last_seen_at >= bindparam("b_since"))
    .order_by(workers.c.seq.desc())
)


def present_workers(
    connection: Connection, *, seen_since: float | None = None
) -> list[RegisteredWorker]:
    """Return the newest session of every name, newest first.

    With `seen_since`, those alive since then.
    """
    since = float("-inf") if seen_since is None else seen_since
    return [_worker(row) for row in _PRESENT_WORKERS.rows(connection, {"b_since": since})]


def builds_for(connection: Connection, kind: str) -> Builds | None:
    """Return the builds for new jobs of `kind`: those of the newest worker that makes it.

    None if no worker has ever told its builds; raise KindNotAvailableError where none of those
    makes it.
    """
    workers = [worker for worker in present_workers(connection) if worker.builds]
    if not workers:
        return None
    for worker in workers:
        if kind in worker.builds:
            return worker.builds[kind]
    kinds = ", ".join(sorted({kind for worker in workers for kind in worker.builds}))
    raise KindNotAvailableError(
        f"no worker makes {kind!r}; those that have registered make {kinds}"
    )


_HEARD = Prepared(
    update(workers)
    .where(
        workers.c.id.in_(
            select(workers.c.id)
            .where(workers.c.id.in_(bindparam("b_ids", expanding=True)))
            .with_for_update(skip_locked=True)
        )
    )
    .values(last_seen_at=bindparam("b_now"))
    .returning(workers.c.id, workers.c.condition)
)


def touch_workers(
    connection: Connection, ids: Collection[str], now: float
) -> dict[str, WorkerCondition]:
    """Store when workers were heard.

    Return how they were, without those that a writer has locked or nobody knows.
    """
    rows = _HEARD.tuples(connection, {"b_ids": ids, "b_now": now})
    return {worker: WorkerCondition.model_validate_json(condition) for worker, condition in rows}


def record_condition(
    connection: Connection, worker_id: str, now: float, condition: WorkerCondition
) -> None:
    values = {"last_seen_at": now, "condition": condition.model_dump_json()}
    connection.execute(update(workers).where(workers.c.id == worker_id).values(values))


def mean_speed(workers: Collection[RegisteredWorker]) -> MachineSpeed:
    """Return the speed of an average slot of some workers; the reference speed if none is ready."""
    slots = sum(worker.condition.slots for worker in workers)
    if slots == 0:
        return MachineSpeed()
    cpu_speed = sum(w.condition.slots * w.condition.speed.cpu_speed for w in workers)
    cpu_available = sum(w.condition.slots * w.condition.speed.cpu_available for w in workers)
    return MachineSpeed(cpu_speed=cpu_speed / slots, cpu_available=cpu_available / slots)


def count_slots(workers: Collection[RegisteredWorker], kind: str, builds: str | None) -> int:
    """Return the number of tasks of a job that can run at once.

    `builds` is JSON, None for an unplanned job.
    """
    if builds is None:
        return 0
    needed = Builds.model_validate_json(builds)
    return sum(worker.condition.slots for worker in workers if worker.builds.get(kind) == needed)


def running_tasks(
    connection: Connection, frames: Mapping[str, tuple[int, int]]
) -> dict[str, list[responses.RunningTask]]:
    """Return the tasks on lease that the principal sees, by worker, the longest-running first.

    `frames` is the progress of simulations.
    """
    rows = connection.execute(
        select(
            tasks.c.owner, tasks.c.key, tasks.c.stage, tasks.c.state, tasks.c.started_at, jobs.c.id
        )
        .outerjoin(jobs, jobs.c.seq == tasks.c.job)
        .where(IS_LEASED, is_visible_project(jobs.c.project))
        .order_by(tasks.c.state.desc(), tasks.c.started_at)
    )
    found: dict[str, list[responses.RunningTask]] = {}
    for owner, key, stage, state, started_at, job in rows:
        since = as_datetime(started_at) if state == "running" else None
        name = task_id(stage, key)
        running = responses.RunningTask(
            task_id=name,
            stage=Stage(stage),
            job=job,
            since=since,
            frames=frames.get(name) if since else None,
        )
        found.setdefault(owner, []).append(running)
    return found


def alive_workers(context: Context, connection: Connection) -> list[RegisteredWorker]:
    """Return the workers that have sent a message within the duration of a lease."""
    return present_workers(connection, seen_since=context.alive_since)


def show_workers(context: Context, connection: Connection) -> list[responses.WorkerEntry]:
    """Return the newest session of every worker as the API shows it."""
    alive_since, held = context.alive_since, running_tasks(connection, context.frames)
    return [
        document_of(
            responses.WorkerEntry,
            worker,
            alive=worker.last_seen_at >= alive_since,
            leased=len(held.get(worker.id, ())),
            running=tuple(task for task in held.get(worker.id, ()) if task.since is not None),
        )
        for worker in present_workers(connection)
    ]


@lru_cache(maxsize=64)
def _builds(document: str) -> Mapping[str, Builds]:
    return MappingProxyType(
        {kind: Builds.model_validate(builds) for kind, builds in json.loads(document).items()}
    )


def _worker(row: Any) -> RegisteredWorker:
    condition = WorkerCondition.model_validate_json(row.condition)
    versions, superseded = json.loads(row.versions), bool(row.superseded)
    times = row.registered_at, row.last_seen_at
    return RegisteredWorker(
        row.id, row.name, _builds(row.builds), condition, versions, *times, superseded
    )


_PLANNED_JOBS = Prepared(
    select(
        jobs.c.seq, jobs.c.state, jobs.c.kind, jobs.c.builds, jobs.c.reason, jobs.c.message
    ).where(jobs.c.state.in_(RUNNABLE), jobs.c.builds.is_not(None))
)


def update_unschedulable_jobs(context: Context) -> None:
    """Set reason and message of the jobs that no connected worker can run, and clear those of the
    others.
    """
    with context.database.read() as connection:
        if not _find_stranded(context, connection):
            return
    with context.transaction() as tx:
        for (job, state), message in _find_stranded(context, tx.connection).items():
            reason = Reason.waiting_for_worker if message else None
            tx.set_job_state(job, JobState(state), reason=reason, message=message)


def _find_stranded(context: Context, connection: Connection) -> dict[tuple[int, str], str]:
    """Return the new messages of planned jobs by seq and state, where they change.

    Empty for jobs that are served.
    """
    alive = alive_workers(context, connection)
    found = {}
    for row in _PLANNED_JOBS.rows(connection):
        message = _stranded_message(row.kind, Builds.model_validate_json(row.builds), alive)
        if message != row.message and (message or row.reason == Reason.waiting_for_worker):
            found[row.seq, row.state] = message
    return found


def _stranded_message(kind: str, builds: Builds, alive: list[RegisteredWorker]) -> str:
    if not alive:
        return "no worker is connected; the job goes on when one is"
    if all(worker.condition.state == "starting" for worker in alive):
        names = ", ".join(worker.name for worker in alive)
        return f"the workers are not ready: {names}; `stickslip workers` says why"
    made = [worker.builds[kind].by_stage for worker in alive if kind in worker.builds]
    if not made:
        return f"no connected worker makes {kind!r}; the job goes on when one does"
    missing = [
        stage
        for stage, build in builds.by_stage.items()
        if all(own[stage] != build for own in made)
    ]
    if missing:
        return (
            f"no connected worker has the builds that this job was planned for (stages: {', '.join(missing)}); it goes "
            "on when one has. To use the builds of today, cancel the job and submit it again."
        )
    return ""
