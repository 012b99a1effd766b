"""Workers: dispatchers that have registered, and what they can run."""

import json
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType
from typing import Any

from sqlalchemy import Connection, bindparam, func, insert, select, text, update
from stickslip_schemas.base.states import Stage
from stickslip_schemas.documents import responses
from stickslip_schemas.documents.worker_api import WorkerRegistration
from stickslip_schemas.plan.builds import Builds

from stickslip_services.clock import as_datetime
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import jobs, tasks, workers
from stickslip_services.errors import KindNotAvailableError, UnknownWorkerError
from stickslip_services.queue.ids import new_id, task_id

NO_WORKER = "no worker has registered yet; the job is planned when one does"


def stage_builds(builds: Builds) -> dict[Stage, str]:
    """Return what a worker must have, to the bit, to run a task of each stage."""
    return {
        Stage.simulate: builds.simulate,
        Stage.render: builds.render,
        Stage.pack: builds.pack,
        Stage.publish: builds.digest,
    }


@dataclass(frozen=True, slots=True)
class RegisteredWorker:
    """A registered worker."""

    id: str
    name: str
    builds: Mapping[str, Builds]
    """Of each kind that it makes."""
    slots: int
    versions: dict[str, str]
    registered_at: float
    last_seen_at: float
    superseded: bool

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds that it makes."""
        return tuple(self.builds)

    def stage_builds(self, kind: str) -> dict[Stage, str]:
        """Return which build of each stage it runs for a kind; nothing where it does not make the kind."""
        return stage_builds(self.builds[kind]) if kind in self.builds else {}


def insert_worker(connection: Connection, registration: WorkerRegistration, now: float) -> RegisteredWorker:
    """Write a registration down; other sessions of the name are superseded."""
    connection.execute(update(workers).where(workers.c.name == registration.name).values(superseded=True))
    worker_id = new_id("worker")
    connection.execute(
        insert(workers).values(
            id=worker_id,
            name=registration.name,
            builds=json.dumps({kind: builds.model_dump() for kind, builds in registration.builds.items()}),
            slots=registration.slots,
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


def present_workers(connection: Connection, *, seen_since: float | None = None) -> list[RegisteredWorker]:
    """Return the newest session of every name, newest first; with `seen_since`, those heard of since then."""
    since = float("-inf") if seen_since is None else seen_since
    return [_worker(row) for row in _PRESENT_WORKERS.rows(connection, {"b_since": since})]


def builds_for(connection: Connection, kind: str) -> Builds | None:
    """Return the builds that a new job of `kind` is planned for: those of the newest worker that makes the kind.

    None where no worker has ever registered; raise KindNotAvailableError where none of those makes it.
    """
    workers = present_workers(connection)
    if not workers:
        return None
    for worker in workers:
        if kind in worker.builds:
            return worker.builds[kind]
    kinds = ", ".join(sorted({kind for worker in workers for kind in worker.kinds}))
    raise KindNotAvailableError(f"no worker makes {kind!r}; those that have registered make {kinds}")


def other_sessions(connection: Connection, name: str) -> list[str]:
    """Return the ids of all sessions that a worker of this name has had."""
    return list(connection.scalars(select(workers.c.id).where(workers.c.name == name)))


def note_seen(connection: Connection, worker_id: str, now: float) -> None:
    """Write down that a worker was heard of."""
    connection.execute(update(workers).where(workers.c.id == worker_id).values(last_seen_at=now))


def count_slots(workers: Collection[RegisteredWorker], kind: str, builds: str | None) -> int:
    """Return how many tasks of a job the workers can run at once; `builds` is JSON, None until the job is planned."""
    if builds is None:
        return 0
    needed = stage_builds(Builds.model_validate_json(builds))
    return sum(worker.slots for worker in workers if worker.stage_builds(kind) == needed)


def leased_counts(connection: Connection) -> dict[str, int]:
    """Return how many tasks each worker holds."""
    query = select(tasks.c.owner, func.count()).where(text("tasks.owner IS NOT NULL")).group_by(tasks.c.owner)
    return dict(connection.execute(query).all())


def running_tasks(
    connection: Connection, frames: Mapping[str, tuple[int, int]]
) -> dict[str, list[responses.RunningTask]]:
    """Return the tasks on lease by worker, those that run longest first; `frames` are what simulations tell."""
    rows = connection.execute(
        select(tasks.c.owner, tasks.c.key, tasks.c.stage, tasks.c.state, tasks.c.started_at, jobs.c.id)
        .outerjoin(jobs, jobs.c.seq == tasks.c.job)
        .where(text("tasks.owner IS NOT NULL"))
        .order_by(tasks.c.state.desc(), tasks.c.started_at)
    )
    found: dict[str, list[responses.RunningTask]] = {}
    for owner, key, stage, state, started_at, job in rows:
        since = as_datetime(started_at) if state == "running" else None
        name = task_id(stage, key)
        running = responses.RunningTask(
            task_id=name, stage=Stage(stage), job=job, since=since, frames=frames.get(name) if since else None
        )
        found.setdefault(owner, []).append(running)
    return found


def show_workers(
    connection: Connection, *, alive_since: float, frames: Mapping[str, tuple[int, int]]
) -> list[responses.WorkerEntry]:
    """Return the newest session of every worker as the API shows it."""
    held = running_tasks(connection, frames)
    return [
        responses.WorkerEntry(
            id=worker.id,
            name=worker.name,
            slots=worker.slots,
            builds=dict(worker.builds),
            versions=worker.versions,
            registered_at=as_datetime(worker.registered_at),
            last_seen_at=as_datetime(worker.last_seen_at),
            alive=worker.last_seen_at >= alive_since,
            leased=len(held.get(worker.id, ())),
            running=tuple(task for task in held.get(worker.id, ()) if task.since is not None),
        )
        for worker in present_workers(connection)
    ]


@lru_cache(maxsize=64)
def _builds(document: str) -> Mapping[str, Builds]:
    return MappingProxyType({kind: Builds.model_validate(builds) for kind, builds in json.loads(document).items()})


def _worker(row: Any) -> RegisteredWorker:
    return RegisteredWorker(
        id=row.id,
        name=row.name,
        builds=_builds(row.builds),
        slots=row.slots,
        versions=json.loads(row.versions),
        registered_at=row.registered_at,
        last_seen_at=row.last_seen_at,
        superseded=bool(row.superseded),
    )
