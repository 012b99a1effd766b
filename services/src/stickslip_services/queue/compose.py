"""Composition of a task when it is leased: its document, with references to the results of its dependencies."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, func, select
from stickslip_schemas.base.keys import Sha256
from stickslip_schemas.base.states import Stage, TaskState
from stickslip_schemas.documents.tasks import PackTask, PublishTask, RenderTask, SimulateTask, task_adapter
from stickslip_schemas.format.manifest import section_samples
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.grid import dataset_id
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import in_parallel

from stickslip_services.access.asker import own_task
from stickslip_services.catalog.versions import find_reserved, reserve_number, version_number
from stickslip_services.database.database import batches
from stickslip_services.database.tables import jobs, samples, task_dependencies, tasks
from stickslip_services.errors import ConflictError, NotFoundError
from stickslip_services.queue.ids import task_id, task_key

AnyTask = SimulateTask | RenderTask | PackTask | PublishTask

Publish = Callable[[bytes], Sha256]
"""Stores an artifact and returns its digest."""


@dataclass(frozen=True, slots=True)
class StoredTask:
    """The columns of a task that define its document."""

    seq: int
    stage: Stage
    payload: str
    preview: bool


def compose_tasks(connection: Connection, stored: Sequence[StoredTask], publish: Publish) -> dict[int, AnyTask]:
    """Return the documents of tasks by `seq`; all their dependencies must be settled.

    The sections of a publish task are stored with `publish`, which takes a while: do not call this in a write
    transaction.
    """
    composers: Mapping[Stage, Callable[[Connection, list[StoredTask]], dict[int, AnyTask]]] = {
        Stage.simulate: _simulate_tasks,
        Stage.render: _render_tasks,
        Stage.pack: lambda connection, group: {task.seq: _pack_task(connection, task) for task in group},
        Stage.publish: lambda connection, group: {task.seq: _publish_task(connection, task, publish) for task in group},
    }
    composed: dict[int, AnyTask] = {}
    for stage, compose in composers.items():
        if group := [task for task in stored if task.stage is stage]:
            composed |= compose(connection, group)
    return composed


def find_task(connection: Connection, name: str, publish: Publish) -> AnyTask:
    """Return a task by its name, composed as by `compose_tasks`.

    Raises NotFoundError, or ConflictError where its dependencies are not settled.
    """
    key = task_key(name)
    columns = (tasks.c.seq, tasks.c.stage, tasks.c.payload, tasks.c.preview, tasks.c.waiting_on)
    asked = tasks.c.key == key, own_task(tasks.c.seq)
    row = None if key is None else connection.execute(select(*columns).where(*asked)).one_or_none()
    if key is None or row is None or task_id(row.stage, key) != name:
        raise NotFoundError(f"there is no task {name[:100]!r}")
    if row.waiting_on:
        raise ConflictError(f"task {name} builds on {row.waiting_on} others that have not ended yet")
    if row.stage == Stage.render and _record_of(connection, row.seq) is None:
        raise ConflictError(f"task {name} has nothing to render: its simulation was rejected")
    stored = StoredTask(row.seq, Stage(row.stage), row.payload, row.preview)
    return compose_tasks(connection, [stored], publish)[row.seq]


def _record_of(connection: Connection, render: int) -> str | None:
    query = select(tasks.c.output).join(task_dependencies, task_dependencies.c.depends_on == tasks.c.seq)
    return connection.scalar(query.where(task_dependencies.c.task == render))


def _simulate_tasks(_connection: Connection, group: list[StoredTask]) -> dict[int, AnyTask]:
    return {
        task.seq: task_adapter.validate_json(f'{{"stage":"simulate","simulation":{task.payload}}}') for task in group
    }


def _render_tasks(connection: Connection, group: list[StoredTask]) -> dict[int, AnyTask]:
    outputs = dict(
        row
        for batch in batches(task.seq for task in group)
        for row in connection.execute(
            select(task_dependencies.c.task, tasks.c.output)
            .join(tasks, tasks.c.seq == task_dependencies.c.depends_on)
            .where(task_dependencies.c.task.in_(batch))
        )
    )
    composed: dict[int, AnyTask] = {}
    for task in group:
        record = json.loads(outputs[task.seq] or "null")["record"]
        composed[task.seq] = RenderTask.model_validate(
            {"render": json.loads(task.payload), "record": record, "preview": task.preview}
        )
    return composed


def _pack_task(connection: Connection, task: StoredTask) -> PackTask:
    payload = json.loads(task.payload)
    spec, _ = _job_spec(connection, payload["job"])
    first = payload["shard"] * spec.samples_per_shard
    slots = _slots(connection, payload["job"], first=first, count=spec.samples_per_shard)
    return PackTask.model_validate({"spec": spec, "shard": payload["shard"], "slots": slots})


def _slots(connection: Connection, job: int, *, first: int, count: int) -> list[dict[str, Any]]:
    simulated, rendered = tasks.alias(), tasks.alias()
    rows = connection.execute(
        select(
            samples.c.slot,
            samples.c.key,
            samples.c.split,
            samples.c.labels,
            samples.c.render_task,
            simulated.c.output.label("simulate_output"),
            rendered.c.output.label("render_output"),
            func.coalesce(rendered.c.state, simulated.c.state).label("state"),
            func.coalesce(rendered.c.reason, simulated.c.reason).label("reason"),
            func.coalesce(rendered.c.message, simulated.c.message).label("message"),
        )
        .join(simulated, simulated.c.seq == samples.c.simulate_task)
        .outerjoin(rendered, rendered.c.seq == samples.c.render_task)
        .where(samples.c.job == job, samples.c.slot >= first, samples.c.slot < first + count)
        .order_by(samples.c.slot)
    )
    slots = []
    for row in rows:
        labels = json.loads(row.labels)
        slot: dict[str, Any] = {"slot": row.slot, "sample_key": row.key.hex(), "split": row.split}
        if row.state == TaskState.rejected:
            slot["labels"] = labels
            slot["rejection"] = _rejection(row)
        else:
            simulation = json.loads(row.simulate_output)
            render = json.loads(row.render_output) if row.render_task is not None else {"labels": {}, "chunks": {}}
            slot["labels"] = labels | simulation["labels"] | render["labels"]
            slot["record"] = simulation["record"]
            slot["chunks"] = render["chunks"]
        slots.append(slot)
    return slots


def _publish_task(connection: Connection, task: StoredTask, publish: Publish) -> PublishTask:
    payload = json.loads(task.payload)
    job = payload["job"]
    spec, builds = _job_spec(connection, job)
    dataset = dataset_id(spec)
    packed = {
        json.loads(shard)["shard"]: output
        for shard, output in connection.execute(
            select(tasks.c.payload, tasks.c.output)
            .join(task_dependencies, task_dependencies.c.depends_on == tasks.c.seq)
            .where(task_dependencies.c.task == task.seq, tasks.c.stage == Stage.pack)
        )
    }
    size = section_samples(spec)
    sections = (
        _section(connection, job, spec, packed, first, min(first + size, spec.sample_count))
        for first in range(0, spec.sample_count, size)
    )
    return PublishTask(
        spec=spec,
        dataset=dataset,
        version=version_number(connection, dataset, task.seq),
        builds=builds,
        sections=tuple(in_parallel(publish, sections)),
        certificate=payload.get("certificate"),
    )


def _section(connection: Connection, job: int, spec: JobSpec, packed: Mapping[int, str], first: int, end: int) -> bytes:
    """Return the slots from `first` to `end`, which are whole shards, as a `PublishSection`."""
    own = (samples.c.job == job, samples.c.slot >= first, samples.c.slot < end)
    keys = connection.scalars(select(samples.c.key).where(*own).order_by(samples.c.slot))
    shards = range(first // spec.samples_per_shard, -(-end // spec.samples_per_shard))
    outputs = [json.loads(packed[shard]) for shard in shards]
    document = {
        "first": first,
        "sample_keys": [key.hex() for key in keys],
        "rejections": _rejections(connection, job, first=first, end=end),
        "files": [file for output in outputs for file in output["files"]],
        "labels": [output["labels"] for output in outputs],
    }
    return json.dumps(document).encode()


def _rejections(connection: Connection, job: int, *, first: int, end: int) -> list[dict[str, Any]]:
    """Return the rejected samples of a job among the slots from `first` to `end`, by slot."""
    last = func.coalesce(samples.c.render_task, samples.c.simulate_task)
    rows = connection.execute(
        select(samples.c.slot, samples.c.key, samples.c.labels, tasks.c.reason, tasks.c.message)
        .join(tasks, tasks.c.seq == last)
        .where(samples.c.job == job, samples.c.slot >= first, samples.c.slot < end)
        .where(tasks.c.state == TaskState.rejected)
        .order_by(samples.c.slot)
    )
    return list(map(_rejection, rows))


def _rejection(row: Any) -> dict[str, Any]:
    return {
        "slot": row.slot,
        "sample_key": row.key.hex(),
        "reason": row.reason,
        "message": row.message,
        "labels": json.loads(row.labels),
    }


def reserve_version(connection: Connection, task: StoredTask) -> None:
    """Reserve the version number of a publish task, for good, so that no other task takes it."""
    if find_reserved(connection, task.seq) is None:
        spec, _ = _job_spec(connection, json.loads(task.payload)["job"])
        dataset = dataset_id(spec)
        reserve_number(connection, dataset, version_number(connection, dataset, task.seq), task.seq)


def _job_spec(connection: Connection, job: int) -> tuple[Any, Builds]:
    row = connection.execute(select(jobs.c.spec, jobs.c.builds).where(jobs.c.seq == job)).one()
    return job_spec_adapter.validate_json(row.spec), Builds.model_validate_json(row.builds)
