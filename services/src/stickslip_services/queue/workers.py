"""Workers: registered dispatchers, their builds, and jobs that no connected worker can run."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

from sqlalchemy import Connection, bindparam, insert, select, update
from stickslip_schemas.base import JobState, Reason, Stage
from stickslip_schemas.documents import responses
from stickslip_schemas.documents.worker_api import WorkerCondition, WorkerRegistration
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.costs import MachineSpeed

from stickslip_services.access.principals import is_visible_project
from stickslip_services.database.database import as_datetime, document_of
from stickslip_services.database.statements import RowQuery
from stickslip_services.database.tables import jobs, tasks, workers
from stickslip_services.errors import KindNotAvailableError, UnknownWorkerError
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import new_id, task_id
from stickslip_services.queue.job_states import set_job_state
from stickslip_services.queue.rows import IS_LEASED

NO_WORKER = (
    "no worker has told its builds yet; the job is planned when one does (see the workers page)"
)


@dataclass(frozen=True, slots=True)
class RegisteredWorker:
    """A session of a dispatcher."""

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


class _WorkerRow(NamedTuple):
    """A row of `workers`."""

    id: str
    name: str
    builds: str
    condition: str
    versions: str
    registered_at: float
    last_seen_at: float
    superseded: bool


_COLUMNS = [workers.c[name] for name in _WorkerRow._fields]
_WORKER = RowQuery(_WorkerRow, select(*_COLUMNS).where(workers.c.id == bindparam("b_id")))


def find_worker(connection: Connection, worker_id: str) -> RegisteredWorker:
    """Return a worker, superseded or not.

    Raises UnknownWorkerError if no worker has the id.
    """
    row = _WORKER.first(connection, {"b_id": worker_id})
    if row is None:
        raise UnknownWorkerError(f"no worker has the id {worker_id!r}: register again")
    return _worker(row)


_PRESENT_WORKERS = RowQuery(
    _WorkerRow,
    select(*_COLUMNS)
    .where(~workers.c.superseded, workers.c.last_seen_at >= bindparam("b_since"))
    .order_by(workers.c.seq.desc()),
)


def present_workers(
    connection: Connection, *, seen_since: float | None = None
) -> list[RegisteredWorker]:
    """Return the newest session of every name, newest first.

    `seen_since` keeps the sessions that have been alive since then.
    """
    since = float("-inf") if seen_since is None else seen_since
    return [_worker(row) for row in _PRESENT_WORKERS.rows(connection, {"b_since": since})]


def builds_for(connection: Connection, kind: str) -> Builds | None:
    """Return the builds for new jobs of `kind`, from the newest worker that makes it.

    Returns None if no worker has ever told its builds. Raises KindNotAvailableError if some have,
    and none of them makes the kind.
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


class _TouchedWorker(NamedTuple):
    id: str
    condition: str


_TOUCH = RowQuery(
    _TouchedWorker,
    update(workers)
    .where(
        workers.c.id.in_(
            select(workers.c.id)
            .where(workers.c.id.in_(bindparam("b_ids", expanding=True)))
            .with_for_update(skip_locked=True)
        )
    )
    .values(last_seen_at=bindparam("b_now"))
    .returning(workers.c.id, workers.c.condition),
)


def touch_workers(
    connection: Connection, ids: Sequence[str], now: float
) -> dict[str, WorkerCondition]:
    """Store the time of messages of workers, and return their conditions.

    Leaves out workers that a writer has locked or nobody knows.
    """
    conditions: dict[str, WorkerCondition] = {}
    for row in _TOUCH.rows(connection, {"b_ids": ids, "b_now": now}):
        conditions[row.id] = WorkerCondition.model_validate_json(row.condition)
    return conditions


def record_condition(
    connection: Connection, worker_id: str, now: float, condition: WorkerCondition
) -> None:
    """Store the condition that a worker reports."""
    values = {"last_seen_at": now, "condition": condition.model_dump_json()}
    connection.execute(update(workers).where(workers.c.id == worker_id).values(values))


def mean_speed(workers: Collection[RegisteredWorker]) -> MachineSpeed:
    """Return the speed of an average slot of some workers; the reference speed if none is ready."""
    slots = sum(worker.condition.slots for worker in workers)
    if slots == 0:
        return MachineSpeed()
    means = {}
    for name in MachineSpeed.model_fields:
        total = sum(w.condition.slots * getattr(w.condition.speed, name) for w in workers)
        means[name] = total / slots
    return MachineSpeed(**means)


def count_slots(workers: Collection[RegisteredWorker], kind: str, builds: Builds) -> int:
    """Return the number of tasks of a kind and of these builds that can run at once."""
    return sum(worker.condition.slots for worker in workers if worker.builds.get(kind) == builds)


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
        .outerjoin(jobs, jobs.c.seq == tasks.c.leased_for)
        .where(IS_LEASED, is_visible_project(jobs.c.project))
        .order_by(tasks.c.state.desc(), tasks.c.started_at)
    )
    tasks_of_worker: dict[str, list[responses.RunningTask]] = {}
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
        tasks_of_worker.setdefault(owner, []).append(running)
    return tasks_of_worker


def alive_workers(context: Context, connection: Connection) -> list[RegisteredWorker]:
    """Return the workers that have sent a message within the duration of a lease."""
    return present_workers(connection, seen_since=context.alive_since)


def show_workers(context: Context, connection: Connection) -> list[responses.WorkerEntry]:
    """Return the newest session of every worker as the API shows it."""
    alive_since = context.alive_since
    tasks_of_worker = running_tasks(connection, context.frames)
    entries: list[responses.WorkerEntry] = []
    for worker in present_workers(connection):
        leased = tasks_of_worker.get(worker.id, [])
        entry = document_of(
            responses.WorkerEntry,
            worker,
            alive=worker.last_seen_at >= alive_since,
            leased=len(leased),
            running=tuple(task for task in leased if task.since is not None),
        )
        entries.append(entry)
    return entries


@lru_cache(maxsize=64)
def _builds(document: str) -> Mapping[str, Builds]:
    return MappingProxyType(
        {kind: Builds.model_validate(builds) for kind, builds in json.loads(document).items()}
    )


def _worker(row: _WorkerRow) -> RegisteredWorker:
    return RegisteredWorker(
        id=row.id,
        name=row.name,
        builds=_builds(row.builds),
        condition=WorkerCondition.model_validate_json(row.condition),
        versions=json.loads(row.versions),
        registered_at=row.registered_at,
        last_seen_at=row.last_seen_at,
        superseded=bool(row.superseded),
    )


# ---- Jobs that no worker can run -----------------------------------------------------------------

CHECK_SECONDS = 10.0
"""Interval of the check which jobs can run, while nothing is known to have changed [s]."""


class _JobGroup(NamedTuple):
    """Jobs that the same workers can run, and that say the same about it."""

    kind: str
    builds: str
    reason: str | None
    message: str


class _PlannedJob(NamedTuple):
    seq: int
    state: str


_IS_PLANNED = (
    "FROM jobs WHERE jobs.finished_at IS NULL "
    "AND jobs.state IN ('planning', 'queued', 'running') AND jobs.builds IS NOT NULL"
)
_JOB_GROUPS = RowQuery(_JobGroup, f"SELECT DISTINCT kind, builds, reason, message {_IS_PLANNED}")
_JOBS_OF_GROUP = RowQuery(
    _PlannedJob,
    f"SELECT seq, state {_IS_PLANNED} AND kind = :b_kind AND builds = :b_builds "
    "AND message = :b_message",
)


def update_unschedulable_jobs(context: Context) -> None:
    """Set reason and message of the jobs that no connected worker can run.

    Clears them for jobs that a worker can run again.
    """
    with context.database.read() as connection:
        alive = alive_workers(context, connection)
        if not _may_have_changed(context, alive):
            return
        if not _changed_messages(connection, alive):
            return
    with context.transaction() as tx:
        for group, message in _changed_messages(tx.connection, alive):
            values = {"b_kind": group.kind, "b_builds": group.builds, "b_message": group.message}
            for job in _JOBS_OF_GROUP.rows(tx.connection, values):
                reason = Reason.waiting_for_worker if message else None
                set_job_state(tx, job.seq, JobState(job.state), reason=reason, message=message)


def _may_have_changed(context: Context, alive: Sequence[RegisteredWorker]) -> bool:
    """Return whether anything was written, or a worker came or went, since the last call."""
    states = tuple((worker.id, worker.condition.state) for worker in alive)
    situation = (context.notifier.count, states)
    now = context.clock()
    if situation == context.last_situation and now < context.next_situation_check:
        return False
    context.last_situation = situation
    context.next_situation_check = now + CHECK_SECONDS
    return True


def _changed_messages(
    connection: Connection, alive: Sequence[RegisteredWorker]
) -> list[tuple[_JobGroup, str]]:
    """Return the groups of jobs whose message changes, with the new one.

    It is empty for jobs that a worker can run.
    """
    changed: list[tuple[_JobGroup, str]] = []
    for group in _JOB_GROUPS.rows(connection):
        message = _unschedulable_message(group, alive)
        if message == group.message:
            continue
        # Messages of other reasons stay while a worker can run the job.
        if message or group.reason == Reason.waiting_for_worker:
            changed.append((group, message))
    return changed


def _unschedulable_message(group: _JobGroup, alive: Sequence[RegisteredWorker]) -> str:
    if not alive:
        return "no worker is connected; the job goes on when one is"
    if all(worker.condition.state == "starting" for worker in alive):
        names = ", ".join(worker.name for worker in alive)
        return f"the workers are not ready: {names}; `stickslip workers` says why"
    offered = [worker.builds[group.kind] for worker in alive if group.kind in worker.builds]
    if not offered:
        return f"no connected worker makes {group.kind!r}; the job goes on when one does"
    # A job of which the row is damaged fails at the next check (background.fail_damaged_jobs).
    needed = _parse_builds(group.builds)
    missing: list[str] = []
    for stage, build in needed.by_stage.items():
        if all(builds.by_stage[stage] != build for builds in offered):
            missing.append(stage)
    if missing:
        return (
            "no connected worker has the builds that this job was planned for (stages: "
            f"{', '.join(missing)}); it goes "
            "on when one has. To use the builds of today, cancel the job and submit it again."
        )
    return ""


@lru_cache(maxsize=64)
def _parse_builds(document: str) -> Builds:
    return Builds.model_validate_json(document)
