"""Composition of a task when it is leased: its document, with references to the results of its
dependencies.
"""

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from typing import Any

from sqlalchemy import Connection, bindparam, select
from sqlalchemy.exc import NoResultFound
from stickslip_schemas.base import Sha256, Stage, TaskState, content_key
from stickslip_schemas.documents.tasks import (
    AnyTask,
    PackTask,
    PublishTask,
    RenderTask,
    task_adapter,
)
from stickslip_schemas.format.manifest import section_samples
from stickslip_schemas.plan.points import pack_key, publish_key
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import in_parallel

from stickslip_services.access.principals import is_visible_task
from stickslip_services.catalog.versions import find_reserved, reserve_number, version_number
from stickslip_services.database.database import Prepared, batches
from stickslip_services.database.tables import samples, task_dependencies, tasks
from stickslip_services.errors import ConflictError, DamagedRowsError, NotFoundError
from stickslip_services.queue.ids import task_id, task_key
from stickslip_services.queue.recompute import check_results, check_samples, read_plan
from stickslip_services.queue.transaction import TASK_COLUMNS

UNSOUND = (DamagedRowsError, ConflictError, NoResultFound, ValueError, KeyError, TypeError)
"""Errors that damaged rows cause."""

Publish = Callable[[bytes], Sha256]
"""Stores an artifact and returns its digest."""

STORED_TASK = [*TASK_COLUMNS, *(tasks.c[name] for name in ("key", "build", "payload", "preview"))]
"""Columns of a task from which its document is composed."""


def compose_task(connection: Connection, task: Any, publish: Publish) -> AnyTask:
    """Return the document of a task, a row with `STORED_TASK`.

    All its dependencies must be settled.

    Raises one of UNSOUND where rows are damaged. Sections of a publish task are stored with
    `publish`, which takes a while: do not call this in a write transaction.
    """
    if task.stage == Stage.simulate:
        _check_key(
            task,
            content_key("simulate", {"simulation": json.loads(task.payload), "build": task.build}),
        )
        return task_adapter.validate_json(f'{{"stage":"simulate","simulation":{task.payload}}}')
    if task.stage == Stage.render:
        return _render_task(connection, task)
    return (
        _pack_task(connection, task)
        if task.stage == Stage.pack
        else _publish_task(connection, task, publish)
    )


def find_task(connection: Connection, name: str, publish: Publish) -> AnyTask:
    """Return a task by its name, see `compose_task`.

    Raises NotFoundError, or ConflictError where its dependencies are not settled.
    """
    key = task_key(name)
    asked = tasks.c.key == key, is_visible_task(tasks.c.seq)
    row = None if key is None else connection.execute(select(tasks).where(*asked)).one_or_none()
    if key is None or row is None or task_id(row.stage, key) != name:
        raise NotFoundError(f"there is no task {name[:100]!r}")
    if row.waiting_on:
        raise ConflictError(
            f"task {name} builds on {row.waiting_on} others that have not ended yet"
        )
    return compose_task(connection, row, publish)


def _check_key(task: Any, key: Sha256) -> None:
    """Raise DamagedRowsError where a task is not what its content key says."""
    if task.key.hex() != key:
        raise DamagedRowsError


def _render_task(connection: Connection, task: Any) -> RenderTask:
    (simulation,) = _results(connection, _needed(connection, task)).values()
    render = json.loads(task.payload)
    document = {"render": render, "simulation": simulation.key.hex(), "build": task.build}
    _check_key(task, content_key("render", document))
    if simulation.output is None:
        raise ConflictError(
            f"the render {task.key.hex()} has nothing to render: its simulation was rejected"
        )
    record = json.loads(simulation.output)["record"]
    return RenderTask.model_validate(
        {"render": render, "record": record, "preview": bool(task.preview)}
    )


_NEEDED = Prepared(
    select(task_dependencies.c.depends_on).where(task_dependencies.c.task == bindparam("b_task"))
)
_RESULTS = Prepared(
    select(
        *(
            tasks.c[name]
            for name in ("seq", "key", "state", "reason", "message", "output", "payload", "digest")
        )
    ).where(tasks.c.seq.in_(bindparam("b_tasks", expanding=True)))
)
_SAMPLES = Prepared(
    select(samples)
    .where(
        samples.c.job == bindparam("b_job"),
        samples.c.slot >= bindparam("b_first"),
        samples.c.slot < bindparam("b_end"),
    )
    .order_by(samples.c.slot)
)


def _needed(connection: Connection, task: Any) -> set[int]:
    return {seq for (seq,) in _NEEDED.tuples(connection, {"b_task": task.seq})}


def _results(connection: Connection, seqs: Collection[int]) -> dict[int, Any]:
    """Return the rows of settled tasks by `seq`.

    Raise DamagedRowsError where what they made is damaged.
    """
    rows = [row for batch in batches(seqs) for row in _RESULTS.rows(connection, {"b_tasks": batch})]
    check_results(rows)
    return {row.seq: row for row in rows}


def _samples(connection: Connection, job: int, first: int, end: int) -> list[Any]:
    """Return the rows of samples by slot; raise DamagedRowsError."""
    rows = _SAMPLES.rows(connection, {"b_job": job, "b_first": first, "b_end": end})
    check_samples(rows, range(first, end))
    return rows


def _pack_task(connection: Connection, task: Any) -> PackTask:
    payload = json.loads(task.payload)
    spec, terms = read_plan(connection, payload["job"])
    first = payload["shard"] * spec.samples_per_shard
    end = min(first + spec.samples_per_shard, spec.sample_count)
    rows = _samples(connection, payload["job"], first, end)
    _check_key(
        task,
        pack_key(
            spec, payload["shard"], [(row.key.hex(), row.split) for row in rows], terms.builds
        ),
    )
    return PackTask.model_validate(
        {"spec": spec, "shard": payload["shard"], "slots": _slots(connection, rows)}
    )


def _slots(connection: Connection, rows: Sequence[Any]) -> list[dict[str, Any]]:
    made = _results(
        connection,
        {seq for row in rows for seq in (row.simulate_task, row.render_task) if seq is not None},
    )
    slots = []
    for row in rows:
        simulated = made[row.simulate_task]
        rendered = made.get(row.render_task)
        labels = json.loads(row.labels)
        slot: dict[str, Any] = {
            "slot": row.slot,
            "sample_key": row.key.hex(),
            "split": row.split,
            "labels": labels,
        }
        last = rendered or simulated
        if last.state == TaskState.rejected:
            slot["rejection"] = _rejection(row, last)
        else:
            simulation = json.loads(simulated.output)
            render = json.loads(rendered.output) if rendered else {"labels": {}, "chunks": {}}
            slot["labels"] = labels | simulation["labels"] | render["labels"]
            slot["record"] = simulation["record"]
            slot["chunks"] = render["chunks"]
        slots.append(slot)
    return slots


def _publish_task(connection: Connection, task: Any, publish: Publish) -> PublishTask:
    payload = json.loads(task.payload)
    job = payload["job"]
    spec, terms = read_plan(connection, job)
    rows = _results(connection, _needed(connection, task)).values()
    packed = {json.loads(row.payload)["shard"]: row for row in rows}
    certificate = payload.get("certificate")
    pack_keys = [packed[shard].key.hex() for shard in sorted(packed)]
    _check_key(task, publish_key(spec, pack_keys, terms.builds, certificate))
    outputs = [json.loads(packed[shard].output) for shard in sorted(packed)]
    size = section_samples(spec)
    sections = (
        _section(connection, job, spec, outputs, first, min(first + size, spec.sample_count))
        for first in range(0, spec.sample_count, size)
    )
    return PublishTask(
        spec=spec,
        dataset=spec.dataset_id,
        version=version_number(connection, spec.dataset_id, task.seq),
        builds=terms.builds,
        sections=tuple(in_parallel(publish, sections)),
        certificate=certificate,
    )


def _section(
    connection: Connection,
    job: int,
    spec: JobSpec,
    outputs: Sequence[Mapping[str, Any]],
    first: int,
    end: int,
) -> bytes:
    """Return the slots from `first` to `end`, which are whole shards, as a `PublishSection`."""
    rows = _samples(connection, job, first, end)
    last = [row.simulate_task if row.render_task is None else row.render_task for row in rows]
    made = _results(connection, set(last))
    of_section = outputs[first // spec.samples_per_shard : -(-end // spec.samples_per_shard)]
    document = {
        "first": first,
        "sample_keys": [row.key.hex() for row in rows],
        "rejections": [
            _rejection(row, made[seq])
            for row, seq in zip(rows, last, strict=True)
            if made[seq].state == TaskState.rejected
        ],
        "files": [file for output in of_section for file in output["files"]],
        "labels": [output["labels"] for output in of_section],
    }
    return json.dumps(document).encode()


def _rejection(sample: Any, task: Any) -> dict[str, Any]:
    return {
        "slot": sample.slot,
        "sample_key": sample.key.hex(),
        "reason": task.reason,
        "message": task.message,
        "labels": json.loads(sample.labels),
    }


def reserve_version(connection: Connection, task: Any) -> None:
    """Reserve the version number of a publish task, for good, so that no other task takes it."""
    with suppress(*UNSOUND):  # composing it finds the damage
        if find_reserved(connection, task.seq) is None:
            dataset = read_plan(connection, json.loads(task.payload)["job"])[0].dataset_id
            reserve_number(
                connection, dataset, version_number(connection, dataset, task.seq), task.seq
            )
