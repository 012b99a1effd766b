"""From a spec to tasks: simulate -> render -> pack -> publish, each keyed by exactly what its result depends on.

A task that is there already is shared: where it is settled the job has it for nothing, where it waits or runs both jobs
wait for it, where it failed or was cancelled the new job starts it again.

`expand` is pure and slow and runs outside any transaction; `insert_plan` writes what it found in one.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from sqlalchemy import Connection, func, select, update
from stickslip_schemas.builds import Builds
from stickslip_schemas.jobs import ClothDragSpec, RodHangSpec
from stickslip_schemas.samples import keyed_points, pack_key, publish_key
from stickslip_schemas.states import Stage, TaskState

from stickslip_services.db import batches, insert_rows
from stickslip_services.ledger import Ledger, add_to_task_counts, ledger
from stickslip_services.tables import job_counts, job_stages, job_tasks, samples, task_dependencies, tasks

Spec = RodHangSpec | ClothDragSpec

_LOST = (TaskState.failed, TaskState.cancelled)


@dataclass(frozen=True, slots=True)
class PlannedTask:
    """A task as a job needs it."""

    stage: Stage
    build: str
    payload: str
    depends_on: tuple[bytes, ...] = ()
    preview: bool = False


@dataclass(frozen=True, slots=True)
class PlannedSample:
    """A slot of the dataset."""

    slot: int
    key: bytes
    simulate_task: bytes
    render_task: bytes | None
    split: int
    labels: str


@dataclass(slots=True)
class Plan:
    """The tasks of a job by content key, in the order in which they should run, and its samples."""

    spec: Spec
    builds: Builds
    tasks: dict[bytes, PlannedTask] = field(default_factory=dict)
    samples: list[PlannedSample] = field(default_factory=list)

    @property
    def publish_key(self) -> bytes:
        """Key of the last task."""
        return next(reversed(self.tasks))

    @property
    def simulation_count(self) -> int:
        """Number of different simulations."""
        return sum(task.stage is Stage.simulate for task in self.tasks.values())


def stage_builds(builds: Builds) -> dict[Stage, str]:
    """Return what a worker must have, to the bit, to run a task of each stage."""
    return {
        Stage.simulate: builds.sim_core,
        Stage.render: builds.blender,
        Stage.pack: builds.packer,
        Stage.publish: builds.digest,
    }


def preview_slots(sample_count: int, previews: int) -> set[int]:
    """Return the slots that are rendered with a preview: the first one, and the others evenly spread."""
    if previews == 0:
        return set()
    return (
        {position * sample_count // previews for position in range(previews)}
        if sample_count > previews
        else set(range(sample_count))
    )


def expand(spec: Spec, builds: Builds, *, previews: int = 0) -> Plan:
    """Return all tasks and samples that `spec` means."""
    plan = Plan(spec, builds)
    build = stage_builds(builds)
    previewed = preview_slots(spec.sample_count, previews)
    pack_keys: list[str] = []
    packs: dict[bytes, PlannedTask] = {}
    for shard, members in enumerate(batches(keyed_points(spec, builds), spec.samples_per_shard)):
        last: dict[bytes, None] = {}  # an ordered set: a grid may have one sample in two slots
        for point in members:
            simulate = bytes.fromhex(point.simulation_key)
            if simulate not in plan.tasks:
                plan.tasks[simulate] = PlannedTask(Stage.simulate, build[Stage.simulate], point.simulation_text)
            render = None
            if point.render_key is not None and point.render_text is not None:
                render = bytes.fromhex(point.render_key)
                if render not in plan.tasks:
                    plan.tasks[render] = PlannedTask(
                        Stage.render, build[Stage.render], point.render_text, (simulate,), point.slot in previewed
                    )
            key = simulate if render is None else render
            last[key] = None
            plan.samples.append(PlannedSample(point.slot, key, simulate, render, point.split, point.labels_text))
        name = pack_key(spec, shard, members, builds)
        pack_keys.append(name)
        packs[bytes.fromhex(name)] = PlannedTask(
            Stage.pack, build[Stage.pack], json.dumps({"shard": shard}), tuple(last)
        )
    plan.tasks.update(packs)
    publish = bytes.fromhex(publish_key(spec, pack_keys, builds))
    plan.tasks[publish] = PlannedTask(Stage.publish, build[Stage.publish], "{}", tuple(packs))
    return plan


@dataclass(frozen=True, slots=True)
class _Known:
    seq: int
    state: TaskState
    reason: str | None = None
    message: str = ""


def count_settled(connection: Connection, keys: Iterable[bytes]) -> int:
    """Return how many of the tasks have a result already."""
    return sum(known.state.is_settled for known in _find(connection, keys).values())


def insert_plan(connection: Connection, job: int, plan: Plan, now: float) -> TaskState:
    """Write the tasks of `job` and return the state of the last of them."""
    known = _find(connection, plan.tasks)
    with ledger(connection, now) as book:
        _revive(book, job, [task for task in known.values() if task.state in _LOST])
    known = {key: _Known(task.seq, TaskState.pending) if task.state in _LOST else task for key, task in known.items()}
    old = frozenset(known)
    known |= _insert_tasks(connection, job, plan, known)
    insert_rows(
        connection,
        job_tasks,
        ("job", "task", "cached"),
        ((job, task.seq, task.state.is_settled) for task in known.values()),
    )
    insert_rows(
        connection,
        samples,
        ("job", "slot", "key", "simulate_task", "render_task", "split", "labels"),
        (
            (
                job,
                sample.slot,
                sample.key,
                known[sample.simulate_task].seq,
                None if sample.render_task is None else known[sample.render_task].seq,
                sample.split,
                sample.labels,
            )
            for sample in plan.samples
        ),
    )
    _insert_counts(connection, job, plan, known, new=known.keys() - old)
    return known[plan.publish_key].state


def _find(connection: Connection, keys: Iterable[bytes]) -> dict[bytes, _Known]:
    found: dict[bytes, _Known] = {}
    if not connection.scalar(select(tasks.c.seq).limit(1)):
        return found
    for batch in batches(keys):
        rows = connection.execute(
            select(tasks.c.key, tasks.c.seq, tasks.c.state, tasks.c.reason, tasks.c.message).where(
                tasks.c.key.in_(batch)
            )
        )
        for key, seq, state, reason, message in rows:
            found[key] = _Known(seq, TaskState(state), reason, message)
    return found


def _revive(book: Ledger, job: int, lost: list[_Known]) -> None:
    """Let failed and cancelled tasks wait for a new try: to submit again is to ask for it."""
    for batch in batches(lost):
        seqs = [task.seq for task in batch]
        rows = book.connection.execute(select(tasks.c.seq, tasks.c.stage, tasks.c.state).where(tasks.c.seq.in_(seqs)))
        for seq, stage, state in rows.all():
            book.moved(seq, stage, state, TaskState.pending)
        book.connection.execute(
            update(tasks)
            .where(tasks.c.seq.in_(seqs))
            .values(state=TaskState.pending, reason=None, message="", job=job, tries=0, retry_at=None, finished_at=None)
        )


def _insert_tasks(connection: Connection, job: int, plan: Plan, known: Mapping[bytes, _Known]) -> dict[bytes, _Known]:
    """Insert the tasks that are not there yet, in the order of the plan, and return them."""
    seq = connection.scalar(select(func.coalesce(func.max(tasks.c.seq), 0))) or 0
    new: dict[bytes, _Known] = {}
    rows = []
    dependencies: list[tuple[int, int]] = []
    payload_job = f'{{"job":{job},'
    for key, task in plan.tasks.items():
        if key in known:
            continue
        seq += 1
        waiting_on = 0
        state, reason, message = TaskState.pending, None, ""
        for needed_key in task.depends_on:
            needed = known.get(needed_key) or new[needed_key]
            dependencies.append((seq, needed.seq))
            if not needed.state.is_settled:
                waiting_on += 1
            elif needed.state is TaskState.rejected and task.stage is Stage.render:
                state, reason, message = needed.state, needed.reason, needed.message
        payload = task.payload
        if task.stage in (Stage.pack, Stage.publish):  # their slots are those of the job that came first
            payload = payload_job + payload[1:] if payload != "{}" else payload_job[:-1] + "}"
        new[key] = _Known(seq, state, reason, message)
        kind, preview = plan.spec.kind, task.preview
        rows.append((seq, key, task.stage, kind, task.build, payload, preview, job, state, reason, message, waiting_on))
    columns = ("seq", "key", "stage", "kind", "build", "payload", "preview")
    insert_rows(connection, tasks, (*columns, "job", "state", "reason", "message", "waiting_on"), rows)
    insert_rows(connection, task_dependencies, ("task", "depends_on"), dependencies)
    return new


def _insert_counts(
    connection: Connection, job: int, plan: Plan, known: Mapping[bytes, _Known], *, new: Iterable[bytes]
) -> None:
    counts = Counter((plan.tasks[key].stage, task.state) for key, task in known.items())
    cached = Counter(plan.tasks[key].stage for key, task in known.items() if task.state.is_settled)
    insert_rows(
        connection,
        job_counts,
        ("job", "stage", "state", "count"),
        [(job, stage, state, counts[stage, state]) for stage in Stage for state in TaskState],
    )
    insert_rows(connection, job_stages, ("job", "stage", "cached"), [(job, s, cached[s]) for s in Stage])
    add_to_task_counts(connection, Counter((plan.tasks[key].stage, known[key].state) for key in new))
