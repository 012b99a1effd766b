"""From a spec to tasks: simulate -> render -> pack -> publish, each keyed by exactly what its result depends on.

A task that is there already is shared: where it is settled the job has it for nothing, where it waits or runs both jobs
wait for it, where it failed or was cancelled the new job starts it again.

`expand` is pure and slow and runs outside any transaction; `insert_plan` writes what it found in one.
"""

import gc
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from sqlalchemy import Connection, func, select, update
from stickslip_schemas.builds import Builds
from stickslip_schemas.jobs import ClothDragSpec, RodHangSpec
from stickslip_schemas.keys import Sha256
from stickslip_schemas.samples import keyed_points, pack_key, publish_key
from stickslip_schemas.states import Stage, TaskState

from stickslip_services.db import batches, insert_rows
from stickslip_services.ledger import add_to_task_counts, ledger
from stickslip_services.tables import job_counts, job_stages, job_tasks, samples, task_dependencies, tasks

Spec = RodHangSpec | ClothDragSpec

_SIMULATE, _RENDER, _PACK, _PUBLISH = (stage.value for stage in Stage)

_LOST = (TaskState.failed, TaskState.cancelled)


class PlannedTask(NamedTuple):
    """A task as a job needs it."""

    stage: str  # a plain str: sqlite3 binds it three times as fast as a member of Stage
    build: str
    payload: str
    depends_on: tuple[bytes, ...] = ()
    preview: bool = False


class PlannedSample(NamedTuple):
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
    certificate: Sha256 | None = None
    tasks: dict[bytes, PlannedTask] = field(default_factory=dict)
    samples: list[PlannedSample] = field(default_factory=list)

    @property
    def publish_key(self) -> bytes:
        """Key of the last task."""
        return next(reversed(self.tasks))

    @property
    def simulation_count(self) -> int:
        """Number of different simulations."""
        return sum(task.stage == _SIMULATE for task in self.tasks.values())


@contextmanager
def collector_at_rest() -> Iterator[None]:
    """Keep the garbage collector from walking through a plan while it grows.

    A plan is a million small objects and no cycles; looking for some takes a fifth of the time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


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
    count = min(sample_count, previews)
    return {position * sample_count // count for position in range(count)}


def expand(spec: Spec, builds: Builds, *, certificate: Sha256 | None = None, previews: int = 0) -> Plan:
    """Return all tasks and samples that `spec` means; the manifest will carry the certificate's digest."""
    plan = Plan(spec, builds, certificate)
    tasks_by_key = plan.tasks
    previewed = preview_slots(spec.sample_count, previews)
    pack_keys: list[str] = []
    packs: dict[bytes, PlannedTask] = {}
    for shard, members in enumerate(batches(keyed_points(spec, builds), spec.samples_per_shard)):
        last: dict[bytes, None] = {}  # an ordered set: a grid may have one sample in two slots
        for point in members:
            key = simulate = bytes.fromhex(point.simulation_key)
            render: bytes | None = None
            if simulate not in tasks_by_key:
                tasks_by_key[simulate] = PlannedTask(_SIMULATE, builds.sim_core, point.simulation_text)
            if point.render_key is not None and point.render_text is not None:
                key = render = bytes.fromhex(point.render_key)
                if render not in tasks_by_key:
                    preview = point.slot in previewed
                    tasks_by_key[render] = PlannedTask(_RENDER, builds.blender, point.render_text, (simulate,), preview)
            last[key] = None
            plan.samples.append(PlannedSample(point.slot, key, simulate, render, point.split, point.labels_text))
        name = pack_key(spec, shard, members, builds)
        pack_keys.append(name)
        payload = json.dumps({"shard": shard})
        packs[bytes.fromhex(name)] = PlannedTask(_PACK, builds.packer, payload, tuple(last))
    tasks_by_key.update(packs)
    publish = bytes.fromhex(publish_key(spec, pack_keys, builds, certificate))
    payload = json.dumps({} if certificate is None else {"certificate": certificate})
    tasks_by_key[publish] = PlannedTask(_PUBLISH, builds.digest, payload, tuple(packs))
    return plan


class _Known(NamedTuple):
    """A task that was in the database before the job."""

    seq: int
    stage: Stage
    state: TaskState
    reason: str | None
    message: str


def count_settled(connection: Connection, keys: Iterable[bytes]) -> int:
    """Return how many of the tasks have a result already."""
    return sum(known.state.is_settled for known in _find(connection, keys).values())


def insert_plan(connection: Connection, job: int, plan: Plan, now: float) -> TaskState:
    """Write the tasks of `job` and return the state of the last of them."""
    known = _find(connection, plan.tasks)
    known |= _revive(connection, job, {key: task for key, task in known.items() if task.state in _LOST}, now)
    seqs, rejected = _insert_tasks(connection, job, plan, known)
    settled = rejected | {task.seq for task in known.values() if task.state.is_settled}
    insert_rows(connection, job_tasks, ("job", "task", "cached"), ((job, seq, seq in settled) for seq in seqs.values()))
    insert_rows(
        connection,
        samples,
        ("job", "slot", "key", "simulate_task", "render_task", "split", "labels"),
        (
            (job, slot, key, seqs[simulate], None if render is None else seqs[render], split, labels)
            for slot, key, simulate, render, split, labels in plan.samples
        ),
    )
    new = Counter(Stage(task.stage) for key, task in plan.tasks.items() if key not in known)
    counts = Counter({(stage, TaskState.pending): count for stage, count in new.items()})
    if rejected:
        counts[Stage.render, TaskState.rejected] += len(rejected)
        counts[Stage.render, TaskState.pending] -= len(rejected)
    add_to_task_counts(connection, counts)
    counts.update((task.stage, task.state) for task in known.values())
    _insert_counts(connection, job, counts)
    return known[plan.publish_key].state if plan.publish_key in known else TaskState.pending


def _find(connection: Connection, keys: Iterable[bytes]) -> dict[bytes, _Known]:
    found: dict[bytes, _Known] = {}
    if not connection.scalar(select(tasks.c.seq).limit(1)):
        return found
    columns = (tasks.c.key, tasks.c.seq, tasks.c.stage, tasks.c.state, tasks.c.reason, tasks.c.message)
    for batch in batches(keys):
        for key, seq, stage, state, reason, message in connection.execute(
            select(*columns).where(tasks.c.key.in_(batch))
        ):
            found[key] = _Known(seq, Stage(stage), TaskState(state), reason, message)
    return found


def _revive(connection: Connection, job: int, lost: Mapping[bytes, _Known], now: float) -> dict[bytes, _Known]:
    """Let failed and cancelled tasks wait for a new try, for to submit again is to ask for it; return them so."""
    with ledger(connection, now) as book:
        for batch in batches(lost.values()):
            for task in batch:
                book.moved(task.seq, task.stage, task.state, TaskState.pending)
            connection.execute(
                update(tasks)
                .where(tasks.c.seq.in_([task.seq for task in batch]))
                .values(
                    state=TaskState.pending,
                    reason=None,
                    message="",
                    job=job,
                    tries=0,
                    retry_at=None,
                    finished_at=None,
                )
            )
    return {key: _Known(task.seq, task.stage, TaskState.pending, None, "") for key, task in lost.items()}


def _insert_tasks(
    connection: Connection, job: int, plan: Plan, known: Mapping[bytes, _Known]
) -> tuple[dict[bytes, int], set[int]]:
    """Insert the tasks that are not there yet, in the order of the plan.

    Return the `seq` of every task of the plan, and those of new renders whose simulation has been rejected before.
    """
    seqs = {key: task.seq for key, task in known.items()}
    settled = {task.seq: task for task in known.values() if task.state.is_settled}
    rejected: set[int] = set()
    rows: list[tuple[Any, ...]] = []
    dependencies: list[tuple[int, int]] = []
    kind = plan.spec.kind
    seq = connection.scalar(select(func.coalesce(func.max(tasks.c.seq), 0))) or 0
    for key, (stage, build, payload, depends_on, preview) in plan.tasks.items():
        if key in seqs:
            continue
        seq += 1
        seqs[key] = seq
        waiting_on = 0
        fate: tuple[str, str | None, str] = ("pending", None, "")
        for needed_key in depends_on:
            needed = seqs[needed_key]
            dependencies.append((seq, needed))
            if needed in rejected:
                continue
            if needed not in settled:
                waiting_on += 1
            elif stage == _RENDER and settled[needed].state is TaskState.rejected:
                fate = ("rejected", settled[needed].reason, settled[needed].message)
                rejected.add(seq)
        if stage in (_PACK, _PUBLISH):  # their slots are those of the job that came first
            payload = json.dumps(json.loads(payload) | {"job": job})
        rows.append((seq, key, stage, kind, build, payload, preview, job, *fate, waiting_on))
    columns = ("seq", "key", "stage", "kind", "build", "payload", "preview", "job")
    insert_rows(connection, tasks, (*columns, "state", "reason", "message", "waiting_on"), rows)
    insert_rows(connection, task_dependencies, ("task", "depends_on"), dependencies)
    return seqs, rejected


def _insert_counts(connection: Connection, job: int, counts: Mapping[tuple[Stage, TaskState], int]) -> None:
    rows = [(job, stage, state, counts.get((stage, state), 0)) for stage in Stage for state in TaskState]
    insert_rows(connection, job_counts, ("job", "stage", "state", "count"), rows)
    settled = (TaskState.succeeded, TaskState.rejected)
    cached = [(job, stage, sum(counts.get((stage, state), 0) for state in settled)) for stage in Stage]
    insert_rows(connection, job_stages, ("job", "stage", "cached"), cached)
