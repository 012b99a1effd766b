"""The plan of a job: its tasks simulate -> render -> pack -> publish, each keyed by what its result
depends on.

Planning is pure and slow: a job of many samples is planned piece by piece, outside any transaction.
A task that exists in the database already is shared. If it is settled, the job gets its result for
free; if it waits or runs, both jobs wait for it; if it failed or was cancelled, the new job starts
it again.
"""

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any, NamedTuple

from sqlalchemy import Connection, func, insert, select, update
from stickslip_schemas.base import JobState, Sha256, Stage, TaskState
from stickslip_schemas.kinds import registered
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.plan.points import Shard, publish_key, shards
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.catalog.inputs import standing_certificate
from stickslip_services.database.database import insert_rows, rows_with
from stickslip_services.database.tables import (
    job_counts,
    job_stages,
    job_tasks,
    jobs,
    samples,
    task_dependencies,
    tasks,
)
from stickslip_services.errors import PresetNotCertifiedError
from stickslip_services.queue.ids import SAMPLE_COLUMNS, new_id, row_digest
from stickslip_services.queue.transaction import (
    FINISHED,
    JOB_COUNTS,
    JOB_GROUPS,
    RESET_ATTEMPTS,
    SETTLED,
    TASK_COLUMNS,
    TASK_COUNTS,
    QueueTransaction,
    reassign,
)
from stickslip_services.queue.workers import builds_for

_SIMULATE, _RENDER, _PACK, _PUBLISH = (stage.value for stage in Stage)


@dataclass(frozen=True, slots=True)
class Terms:
    """The builds of the workers that make a job, and the certificate of their physics, if there is
    one.
    """

    builds: Builds
    certificate: Sha256 | None


def terms_for(connection: Connection, spec: JobSpec) -> Terms | None:
    """Return builds and certificate for a job of `spec`, None if no worker has ever registered.

    Raises KindNotAvailableError where no worker makes the kind, UnknownKindError where its class is
    not registered, and PresetNotCertifiedError where the spec needs a certificate and its preset
    has none that passed for the workers' build with all protocols that the spec needs.
    """
    builds = builds_for(connection, registered(spec).kind)
    if builds is None:
        return None
    standing = standing_certificate(connection, spec.certified_preset, builds.sim_core)
    missing = (
        []
        if standing is None
        else [name for name in spec.certified_protocols if name not in standing[1]]
    )
    certificate = None if standing is None or missing else standing[0]
    if certificate is None and spec.needs_certificate:
        raise PresetNotCertifiedError(spec.certified_preset, builds.sim_core, missing)
    return Terms(builds, certificate)


class PlannedTask(NamedTuple):
    stage: str  # a plain str: sqlite3 binds it three times as fast as a member of Stage
    build: str
    payload: str
    depends_on: tuple[bytes, ...] = ()
    preview: bool = False
    cost_group: str = ""


class PlannedSample(NamedTuple):
    slot: int
    key: bytes
    simulate_task: bytes
    render_task: bytes | None
    split: int
    labels: str


@dataclass(slots=True)
class Plan:
    """Tasks by content key, in the order of execution, and samples: of a whole job, or of one
    piece.
    """

    spec: JobSpec
    first: int
    """The first slot."""
    tasks: dict[bytes, PlannedTask] = field(default_factory=dict)
    samples: list[PlannedSample] = field(default_factory=list)

    @property
    def end(self) -> int:
        """The slot after the last one."""
        return self.first + len(self.samples)

    @property
    def is_last(self) -> bool:
        """True where it ends with the task that publishes."""
        return self.end == self.spec.sample_count

    @property
    def publish_key(self) -> bytes:
        """Key of the last task, of the last piece."""
        return next(reversed(self.tasks))


def expand(spec: JobSpec, terms: Terms, *, previews: int = 0) -> Plan:
    """Return the whole plan of `spec` as one piece."""
    return next(pieces(spec, terms, size=spec.sample_count, previews=previews))


def pieces(
    spec: JobSpec,
    terms: Terms,
    *,
    size: int,
    previews: int = 0,
    first: int = 0,
    packed: Sequence[str] = (),
) -> Iterator[Plan]:
    """Yield the plan of `spec` in pieces of whole shards, of about `size` samples each.

    Together the pieces are the plan that `expand` returns, for any `size`. To continue from slot
    `first`, pass the keys of the pack tasks before it as `packed`, in order.
    """
    per_shard = spec.samples_per_shard
    count = min(spec.sample_count, previews)
    previewed = {
        position * spec.sample_count // count for position in range(count)
    }  # the first, and evenly spread
    pack_keys = list(packed)
    waiting = shards(spec, terms.builds, first=first // per_shard)
    while some := list(islice(waiting, -(-size // per_shard))):
        yield _piece(spec, terms, some, previewed, pack_keys)


def _piece(
    spec: JobSpec, terms: Terms, some: Sequence[Shard], previewed: set[int], pack_keys: list[str]
) -> Plan:
    """Return the plan of some shards; add the keys of their pack tasks to `pack_keys`."""
    builds = terms.builds
    plan = Plan(spec, some[0].points[0].slot)
    tasks_by_key = plan.tasks
    packs: dict[bytes, PlannedTask] = {}
    renders: dict[
        tuple[Any, ...], dict[bytes, PlannedTask]
    ] = {}  # by shading: those that can be made together
    for shard in some:
        last: dict[bytes, None] = {}  # an ordered set: a grid may have one sample in two slots
        for point in shard.points:
            key = simulate = bytes.fromhex(point.simulation_key)
            render: bytes | None = None
            if simulate not in tasks_by_key:
                cost = spec.cost_group(Stage.simulate, point.labels)
                tasks_by_key[simulate] = PlannedTask(
                    _SIMULATE, builds.simulate, point.simulation_text, cost_group=cost
                )
            if point.render_key is not None and point.render_text is not None:
                key = render = bytes.fromhex(point.render_key)
                shared = (
                    value for axis, value in point.labels.items() if axis != spec.variant_axis
                )
                group = renders.setdefault((simulate, *shared), {})
                if render not in group:
                    preview = point.slot in previewed
                    cost = spec.cost_group(Stage.render, point.labels)
                    group[render] = PlannedTask(
                        _RENDER, builds.render, point.render_text, (simulate,), preview, cost
                    )
            last[key] = None
            plan.samples.append(
                PlannedSample(point.slot, key, simulate, render, point.split, point.labels_text)
            )
        pack_keys.append(shard.pack_key)
        payload = json.dumps({"shard": shard.number})
        packs[bytes.fromhex(shard.pack_key)] = PlannedTask(_PACK, builds.pack, payload, tuple(last))
    for group in renders.values():
        tasks_by_key.update(group)
    tasks_by_key.update(packs)
    if plan.is_last:
        publish = bytes.fromhex(publish_key(spec, pack_keys, builds, terms.certificate))
        payload = json.dumps(
            {} if terms.certificate is None else {"certificate": terms.certificate}
        )
        depends_on = tuple(map(bytes.fromhex, pack_keys))
        tasks_by_key[publish] = PlannedTask(_PUBLISH, builds.digest, payload, depends_on)
    return plan


_LOST = (TaskState.failed, TaskState.cancelled)


def insert_job(tx: QueueTransaction, spec: JobSpec, *, priority: int = 0, project: str = "") -> int:
    """Insert a job without its tasks; return its `seq`."""
    text = spec.model_dump_json()
    result = tx.connection.execute(
        insert(jobs).values(
            id=new_id("job"),
            name=spec.name,
            project=project,
            kind=spec.kind,
            spec=text,
            digest=row_digest(text, None, None),
            sample_count=spec.sample_count,
            state=JobState.queued,
            message="",
            rejected_count=0,
            priority=priority,
            created_at=tx.now,
        )
    )
    return int(result.inserted_primary_key[0])  # type: ignore[index]  # of one inserted row it is never None


def begin_planning(tx: QueueTransaction, job: int, terms: Terms, plan: Plan | None = None) -> None:
    """Store the terms of a job, start its counters, and write its whole plan, or have it planned
    piece by piece.
    """
    spec = tx.connection.scalar(select(jobs.c.spec).where(jobs.c.seq == job))
    values = {"builds": terms.builds.model_dump_json(), "certificate": terms.certificate}
    digest = row_digest(spec, *values.values())
    tx.connection.execute(update(jobs).where(jobs.c.seq == job).values(values | {"digest": digest}))
    rows = [(job, stage, state, 0) for stage in Stage for state in TaskState]
    insert_rows(tx.connection, job_counts, ("job", "stage", "state", "count"), rows)
    insert_rows(
        tx.connection, job_stages, ("job", "stage", "cached"), [(job, stage, 0) for stage in Stage]
    )
    tx.set_job_state(job, JobState.planning if plan is None else JobState.queued)
    if plan is not None:
        write_plan(tx, job, plan)


def write_plan(tx: QueueTransaction, job: int, piece: Plan) -> None:
    """Insert the tasks of a piece of a job; the last piece makes a `planning` job `queued`.

    If its dataset exists already, the job ends once the dataset has been checked (`recompute`).
    """
    last = _insert_plan(tx, job, piece)
    tx.connection.execute(update(jobs).where(jobs.c.seq == job).values(planned=piece.end))
    if not piece.is_last:
        return
    publish_task = tx.connection.scalar(select(tasks.c.seq).where(tasks.c.key == piece.publish_key))
    done = {"publish_task": publish_task, "planner": None, "planner_until": None}
    tx.connection.execute(update(jobs).where(jobs.c.seq == job).values(done))
    if last == TaskState.succeeded:
        message = "the dataset exists already: its files are being checked"
        tx.set_job_state(job, JobState.queued, message=message)
    elif tx.connection.scalar(select(jobs.c.state).where(jobs.c.seq == job)) == JobState.planning:
        tx.set_job_state(job, JobState.queued)


_KNOWN = [*TASK_COLUMNS, *(tasks.c[name] for name in ("key", "reason", "message", "cost_group"))]
"""Columns of tasks that were in the database before the piece."""


def _insert_plan(tx: QueueTransaction, job: int, plan: Plan) -> str:
    """Insert the tasks of `job`; return the state of the last one."""
    connection = tx.connection
    needed = {key for task in plan.tasks.values() for key in task.depends_on} - plan.tasks.keys()
    known = {}
    if connection.scalar(select(tasks.c.seq).limit(1)):
        found = rows_with(connection, select(*_KNOWN), tasks.c.key, [*plan.tasks, *needed])
        known = {row.key: row for row in found}
    seqs, rejected = _insert_tasks(connection, job, plan, known)
    of_job = select(job_tasks.c.task).where(job_tasks.c.job == job)
    earlier = rows_with(connection, of_job, job_tasks.c.task, (task.seq for task in known.values()))
    own = {row.task for row in earlier}  # of earlier pieces
    shared = [task for task in known.values() if task.seq not in own]
    settled = rejected | {task.seq for task in shared if task.state in SETTLED}
    held = ((job, seq, seq in settled) for seq in seqs.values() if seq not in own)
    insert_rows(connection, job_tasks, ("job", "task", "cached"), held)
    insert_rows(
        connection,
        samples,
        (*SAMPLE_COLUMNS, "digest"),
        (
            (*row, row_digest(*row))
            for slot, key, simulate, render, split, labels in plan.samples
            for row in [
                (
                    job,
                    slot,
                    key,
                    seqs[simulate],
                    None if render is None else seqs[render],
                    split,
                    labels,
                )
            ]
        ),
    )
    new = Counter(
        (
            task.stage,
            task.cost_group,
            TaskState.rejected if seqs[key] in rejected else TaskState.pending,
        )
        for key, task in plan.tasks.items()
        if key not in known
    )
    overall = Counter[Any]()
    for (stage, _, state), count in new.items():
        overall[stage, state] += count
    TASK_COUNTS.add(connection, overall)
    _add_counts(
        connection, job, new + Counter((task.stage, task.cost_group, task.state) for task in shared)
    )
    lost = [task for task in shared if task.state in _LOST]
    tx.set_task_state(lost, TaskState.pending, **RESET_ATTEMPTS)  # which changes the counts
    for key, old in known.items():
        if old.state in _LOST and key in plan.tasks:  # its row may have been damaged
            values = {"payload": _payload(plan.tasks[key], job), "build": plan.tasks[key].build}
            connection.execute(update(tasks).where(tasks.c.seq == old.seq).values(values))
    reassign(tx, [task for task in shared if task.state not in SETTLED])
    return (
        known[plan.publish_key].state
        if plan.is_last and plan.publish_key in known
        else TaskState.pending
    )


def _insert_tasks(
    connection: Connection, job: int, plan: Plan, known: Mapping[bytes, Any]
) -> tuple[dict[bytes, int], set[int]]:
    """Insert the tasks that are new, in the order of the plan.

    Return the `seq` of every task of the plan, and those of new renders whose simulation has been
    rejected before.
    """
    seqs = {key: task.seq for key, task in known.items()}
    settled = {task.seq: task for task in known.values() if task.state in SETTLED}
    rejected: set[int] = set()
    rows: list[tuple[Any, ...]] = []
    dependencies: list[tuple[int, int]] = []
    kind = plan.spec.kind
    seq = connection.scalar(select(func.coalesce(func.max(tasks.c.seq), 0))) or 0
    for key, task in plan.tasks.items():
        if key in seqs:
            continue
        stage, build, _, depends_on, preview, cost_group = task
        seq += 1
        seqs[key] = seq
        waiting_on = 0
        fate: tuple[str, str | None, str, int | None] = ("pending", None, "", None)
        for needed_key in depends_on:
            needed = seqs[needed_key]
            dependencies.append((seq, needed))
            if needed in rejected:
                continue
            if needed not in settled:
                waiting_on += 1
            elif stage == Stage.render and settled[needed].state == TaskState.rejected:
                why = ("rejected", settled[needed].reason, settled[needed].message)
                fate = (*why, row_digest(key, *why, None))
                rejected.add(seq)
        rows.append(
            (
                seq,
                key,
                stage,
                kind,
                build,
                _payload(task, job),
                preview,
                cost_group,
                job,
                *fate,
                waiting_on,
            )
        )
    columns = ("seq", "key", "stage", "kind", "build", "payload", "preview", "cost_group", "job")
    insert_rows(
        connection, tasks, (*columns, "state", "reason", "message", "digest", "waiting_on"), rows
    )
    insert_rows(connection, task_dependencies, ("task", "depends_on"), dependencies)
    return seqs, rejected


def _payload(task: PlannedTask, job: int) -> str:
    """Return the document of a task.

    The slots of pack and publish are those of the job that came first.
    """
    if task.stage in (Stage.pack, Stage.publish):
        return json.dumps(json.loads(task.payload) | {"job": job})
    return task.payload


def _add_counts(connection: Connection, job: int, held: Mapping[tuple[str, str, str], int]) -> None:
    """Count tasks that a job has, by stage, cost group and state."""
    counts, left, cached = Counter[Any](), Counter[Any](), Counter[str]()
    for (stage, group, state), count in held.items():
        counts[job, stage, state] += count
        left[job, stage, group] += count * (state not in FINISHED)
        cached[stage] += count * (state in SETTLED)
    JOB_COUNTS.add(connection, counts)
    JOB_GROUPS.add(connection, left)
    for stage, count in (+cached).items():
        own = (job_stages.c.job == job, job_stages.c.stage == stage)
        connection.execute(
            update(job_stages).where(*own).values(cached=job_stages.c.cached + count)
        )
