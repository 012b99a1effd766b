"""Documents of tasks: the work and the results that it needs, composed when a task is leased."""

import json
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol

from sqlalchemy import Connection, bindparam, select, text
from stickslip_schemas.base import Sha256, Stage, TaskState
from stickslip_schemas.documents.tasks import (
    AnyTask,
    PackTask,
    PublishTask,
    RenderTask,
    task_adapter,
)
from stickslip_schemas.format.manifest import section_samples
from stickslip_schemas.spec.jobs import JobSpec
from stickslip_schemas.store import in_parallel

from stickslip_services.access.principals import is_visible_task
from stickslip_services.catalog.versions import find_reserved, reserve_number, version_number
from stickslip_services.database.statements import RowQuery, ValueQuery
from stickslip_services.database.tables import jobs, samples, tasks
from stickslip_services.errors import ConflictError, DamagedRowError, NotFoundError
from stickslip_services.queue.ids import task_id, task_key
from stickslip_services.queue.integrity import (
    check_results,
    check_samples,
    check_task,
    plan_inputs_of,
    reported_damage,
    spec_of,
)
from stickslip_services.queue.rows import (
    JobRow,
    PlanInputs,
    SampleRow,
    StoredTask,
    TaskResultRow,
    TaskRow,
    job_columns,
    task_columns,
)

_WITHOUT_RESULT = [state.value for state in TaskState if not state.is_settled]

Publish = Callable[[bytes], Sha256]
"""Stores an artifact and returns its digest."""

_JOB = RowQuery(JobRow, select(*job_columns(JobRow)).where(jobs.c.seq == bindparam("b_job")))
_DEPENDENCIES: ValueQuery[int] = ValueQuery(
    "SELECT depends_on FROM task_dependencies WHERE task = :b_task"
)
_RESULTS = RowQuery(
    TaskResultRow,
    select(*task_columns(TaskResultRow)).where(
        tasks.c.seq.in_(bindparam("b_tasks", expanding=True))
    ),
)
_SAMPLES = RowQuery(
    SampleRow,
    select(*(samples.c[name] for name in SampleRow._fields))
    .where(
        samples.c.job == bindparam("b_job"),
        samples.c.slot >= bindparam("b_first"),
        samples.c.slot < bindparam("b_end"),
    )
    .order_by(samples.c.slot),
)


class MissingResultsError(Exception):
    """A document needs results of tasks that run again, and its task does not depend on them.

    For example, a pack task depends on renders only, but also reads the results of their
    simulations.
    """

    def __init__(self, tasks: Sequence[int]) -> None:
        self.tasks = tasks
        super().__init__("results of the task are being computed again: try again later")


class NoValidSamplesError(Exception):
    """All samples of a dataset were rejected, so there is nothing to publish."""


class Leasable(TaskRow, Protocol):
    """A `StoredTask`, or a row with more columns."""

    @property
    def build(self) -> str: ...
    @property
    def payload(self) -> str: ...
    @property
    def payload_digest(self) -> int: ...
    @property
    def preview(self) -> bool: ...


def compose_task(connection: Connection, task: Leasable, publish: Publish) -> AnyTask:
    """Return the document of a task whose dependencies all have results.

    `publish` stores the sections of a publish task, which takes a while. So do not call this in a
    write transaction. Raises DamagedRowError if a row is damaged, MissingResultsError, or
    NoValidSamplesError.
    """
    with reported_damage():
        check_task(task)
        match Stage(task.stage):
            case Stage.simulate:
                document = f'{{"stage":"simulate","simulation":{task.payload}}}'
                return task_adapter.validate_json(document)
            case Stage.render:
                return _render_task(connection, task)
            case Stage.pack:
                return _pack_task(connection, task)
            case Stage.publish:
                return _publish_task(connection, task, publish)


def find_task(connection: Connection, name: str, publish: Publish) -> AnyTask:
    """Return the document of a task by its name (see `compose_task`).

    Raises NotFoundError, or ConflictError if its dependencies have no results.
    """
    key = task_key(name)
    columns = (*task_columns(StoredTask), tasks.c.waiting_on)
    is_visible = (tasks.c.key == key, is_visible_task(tasks.c.seq))
    row = None
    if key is not None:
        row = connection.execute(select(*columns).where(*is_visible)).one_or_none()
    # The same key with another stage names no task.
    if row is None or task_id(row.stage, row.key) != name:
        raise NotFoundError(f"there is no task {name[:100]!r}")
    if row.waiting_on:
        raise ConflictError(
            f"task {name} builds on {row.waiting_on} others that have not ended yet"
        )
    stored = StoredTask(*row[: len(StoredTask._fields)])
    try:
        return compose_task(connection, stored, publish)
    except (MissingResultsError, NoValidSamplesError) as error:
        raise ConflictError(str(error)) from error


def read_plan(connection: Connection, job: int) -> tuple[JobSpec, PlanInputs]:
    """Return spec, builds and certificate of a planned job.

    Raises DamagedRowError if the row of the job is damaged.
    """
    row = _JOB.first(connection, {"b_job": job})
    if row is None:
        raise DamagedRowError(f"row {job} of jobs")
    inputs = plan_inputs_of(row)
    assert inputs is not None, "a job is planned before its tasks are leased"
    return spec_of(row), inputs


def reserve_version(connection: Connection, task: Leasable) -> None:
    """Reserve the version number of a publish task for good, so that no other task takes it."""
    if find_reserved(connection, task.seq) is not None:
        return
    try:
        check_task(task)
        spec, _ = read_plan(connection, json.loads(task.payload)["job"])
    except DamagedRowError:
        return  # composing it finds the damage again, and fails it
    number = version_number(connection, spec.dataset_id, task.seq)
    reserve_number(connection, spec.dataset_id, number, task.seq)


def _results(connection: Connection, seqs: Collection[int]) -> dict[int, TaskResultRow]:
    """Return the results of tasks by `seq`.

    Raises MissingResultsError or DamagedRowError.
    """
    rows = _RESULTS.batched_rows(connection, "b_tasks", seqs)
    missing = [row.seq for row in rows if row.state in _WITHOUT_RESULT]
    if missing:
        raise MissingResultsError(missing)
    check_results(rows)
    return {row.seq: row for row in rows}


def _results_of_dependencies(connection: Connection, task: Leasable) -> list[TaskResultRow]:
    seqs = _DEPENDENCIES.values(connection, {"b_task": task.seq})
    return list(_results(connection, seqs).values())


def _output(row: TaskResultRow) -> dict[str, object]:
    """Return the output of a task that succeeded."""
    assert row.output is not None, "a task that succeeded has an output"
    output: dict[str, object] = json.loads(row.output)
    return output


def _read_samples(connection: Connection, job: int, first: int, end: int) -> list[SampleRow]:
    """Return the samples of the slots from `first` to `end`.

    Raises DamagedRowError if a row is damaged or missing.
    """
    rows = _SAMPLES.rows(connection, {"b_job": job, "b_first": first, "b_end": end})
    check_samples(rows, job, range(first, end))
    return rows


# ---- Render --------------------------------------------------------------------------------------


def _render_task(connection: Connection, task: Leasable) -> RenderTask:
    (simulation,) = _results_of_dependencies(connection, task)
    if simulation.output is None:
        raise ConflictError(
            f"the render {task.key.hex()} has nothing to render: its simulation was rejected"
        )
    document = {
        "render": json.loads(task.payload),
        "record": _output(simulation)["record"],
        "preview": bool(task.preview),
    }
    return RenderTask.model_validate(document)


# ---- Pack ----------------------------------------------------------------------------------------


def _pack_task(connection: Connection, task: Leasable) -> PackTask:
    payload = json.loads(task.payload)
    spec, _ = read_plan(connection, payload["job"])
    first = payload["shard"] * spec.samples_per_shard
    end = min(first + spec.samples_per_shard, spec.sample_count)
    rows = _read_samples(connection, payload["job"], first, end)

    # A slot needs the result of its simulation even if a render follows: it has the record.
    seqs: set[int] = set()
    for row in rows:
        seqs.add(row.simulate_task)
        seqs.add(row.last_task)
    results = _results(connection, seqs)
    slots = [_slot(row, results) for row in rows]
    return PackTask.model_validate({"spec": spec, "shard": payload["shard"], "slots": slots})


def _slot(sample: SampleRow, results: Mapping[int, TaskResultRow]) -> dict[str, object]:
    """Return a sample in the form of a pack task, with its results or its rejection."""
    last = results[sample.last_task]
    labels = json.loads(sample.labels)
    slot: dict[str, object] = {
        "slot": sample.slot,
        "sample_key": sample.key.hex(),
        "split": sample.split,
        "labels": labels,
    }
    # A rejected sample stays in the dataset as a slot without data, with the reason.
    if last.state == TaskState.rejected:
        slot["rejection"] = _rejection(sample, last)
        return slot
    simulation = json.loads(results[sample.simulate_task].output or "")
    labels.update(simulation["labels"])
    slot["record"] = simulation["record"]
    slot["chunks"] = {}
    if sample.render_task is not None:
        render = json.loads(last.output or "")
        labels.update(render["labels"])
        slot["chunks"] = render["chunks"]
    return slot


def _rejection(sample: SampleRow, result: TaskResultRow) -> dict[str, object]:
    return {
        "slot": sample.slot,
        "sample_key": sample.key.hex(),
        "reason": result.reason,
        "message": result.message,
        "labels": json.loads(sample.labels),
    }


# ---- Publish -------------------------------------------------------------------------------------


class _Rejection(NamedTuple):
    reason: str | None
    number: int


# The search ends at the first valid sample. In most jobs it is one of the first slots.
_VALID_SAMPLE: ValueQuery[int] = ValueQuery(
    "SELECT samples.slot FROM samples JOIN tasks "
    "ON tasks.seq = coalesce(samples.render_task, samples.simulate_task) "
    "WHERE samples.job = :b_job AND tasks.state != 'rejected' LIMIT 1"
)
_REJECTIONS = RowQuery(
    _Rejection,
    text(
        "SELECT tasks.reason, count(*) FROM samples JOIN tasks "
        "ON tasks.seq = coalesce(samples.render_task, samples.simulate_task) "
        "WHERE samples.job = :b_job AND tasks.state = 'rejected' GROUP BY tasks.reason"
    ),
)


def _check_valid_samples(connection: Connection, job: int, spec: JobSpec) -> None:
    """Raise NoValidSamplesError if all samples of a job were rejected."""
    if _VALID_SAMPLE.first(connection, {"b_job": job}) is not None:
        return
    counts = Counter[str]()
    for row in _REJECTIONS.rows(connection, {"b_job": job}):
        counts[str(row.reason)] += row.number
    ((reason, count),) = counts.most_common(1)
    raise NoValidSamplesError(
        f"0 of {spec.sample_count} samples are valid, so no dataset is published: all were "
        f"rejected, most often as {reason} ({count} of {spec.sample_count}). The samples of the "
        "job are listed with their reasons; change the spec and submit it again"
    )


def _publish_task(connection: Connection, task: Leasable, publish: Publish) -> PublishTask:
    payload = json.loads(task.payload)
    job = payload["job"]
    spec, inputs = read_plan(connection, job)
    # Dependencies come in no order, and the dataset needs its shards in theirs.
    packs: dict[int, TaskResultRow] = {}
    for row in _results_of_dependencies(connection, task):
        packs[json.loads(row.payload)["shard"]] = row
    # Check this before any section is stored.
    _check_valid_samples(connection, job, spec)

    outputs = [_output(packs[shard]) for shard in sorted(packs)]
    return PublishTask(
        spec=_without_name(connection, job, spec),
        dataset=spec.dataset_id,
        version=version_number(connection, spec.dataset_id, task.seq),
        builds=inputs.builds,
        sections=tuple(in_parallel(publish, _sections(connection, job, spec, outputs))),
        certificate=payload.get("certificate"),
    )


def _without_name(connection: Connection, job: int, spec: JobSpec) -> JobSpec:
    """Return a spec for the manifest of a dataset, without the name if the job has a project.

    Another project that specifies the same samples reads the same files, and a name may be a
    secret. Jobs without a project belong to people who see all projects.
    """
    project = connection.scalar(select(jobs.c.project).where(jobs.c.seq == job))
    return spec.model_copy(update={"name": None}) if project else spec


def _sections(
    connection: Connection, job: int, spec: JobSpec, packs: Sequence[Mapping[str, object]]
) -> Iterator[bytes]:
    """Yield the slots of a dataset as `PublishSection`s of whole shards.

    `packs` are the outputs of the pack tasks by shard.
    """
    size = section_samples(spec)
    for first in range(0, spec.sample_count, size):
        end = min(first + size, spec.sample_count)
        # Round up: the last shard of a dataset may be short.
        last_shard = -(-end // spec.samples_per_shard)
        shards = packs[first // spec.samples_per_shard : last_shard]
        yield _section(connection, job, range(first, end), shards)


def _section(
    connection: Connection, job: int, slots: range, packs: Sequence[Mapping[str, object]]
) -> bytes:
    rows = _read_samples(connection, job, slots.start, slots.stop)
    results = _results(connection, {row.last_task for row in rows})
    rejections: list[dict[str, object]] = []
    for row in rows:
        result = results[row.last_task]
        if result.state == TaskState.rejected:
            rejections.append(_rejection(row, result))
    files: list[object] = []
    labels: list[object] = []
    for output in packs:
        pack_files = output["files"]
        assert isinstance(pack_files, list)
        files += pack_files
        labels.append(output["labels"])
    document = {
        "first": slots.start,
        "sample_keys": [row.key.hex() for row in rows],
        "rejections": rejections,
        "files": files,
        "labels": labels,
    }
    return json.dumps(document).encode()
