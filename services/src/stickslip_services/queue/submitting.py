"""Writing a job and its plan down.

A task that is there already is shared: where it is settled the job has it for nothing, where it waits or runs both jobs
wait for it, where it failed or was cancelled the new job starts it again.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from sqlalchemy import Connection, func, insert, select, update
from stickslip_schemas.jobs import JobSpec
from stickslip_schemas.states import JobState, Reason, Stage, TaskState

from stickslip_services.database.database import batches, insert_rows
from stickslip_services.database.tables import (
    job_counts,
    job_groups,
    job_stages,
    job_tasks,
    jobs,
    samples,
    task_dependencies,
    tasks,
)
from stickslip_services.queue.events import set_job_state
from stickslip_services.queue.ids import new_id
from stickslip_services.queue.ledger import OVER, Ledger, charge_waiting_tasks
from stickslip_services.queue.planning import Plan
from stickslip_services.queue.workers import NO_WORKER

_LOST = (TaskState.failed, TaskState.cancelled)


def insert_job(book: Ledger, spec: JobSpec, plan: Plan | None, *, priority: int = 0) -> int:
    """Write a job down, and its tasks if it can be planned already; return its `seq`."""
    reason, message = (None, "") if plan else (Reason.waiting_for_worker, NO_WORKER)
    result = book.connection.execute(
        insert(jobs).values(
            id=new_id("job"),
            name=spec.name,
            kind=spec.kind,
            spec=spec.model_dump_json(),
            sample_count=spec.sample_count,
            state=JobState.queued,
            message=message,
            rejected_count=0,
            priority=priority,
            created_at=book.now,
        )
    )
    job = int(result.inserted_primary_key[0])  # type: ignore[index]  # of one inserted row it is never None
    set_job_state(book.connection, job, JobState.queued, book.now, reason=reason, message=message)
    if plan is not None:
        plan_job(book, job, plan)
    return job


def plan_job(book: Ledger, job: int, plan: Plan) -> None:
    """Write the tasks of a job. If its dataset was made before, it ends once that has been checked (`reopening`)."""
    last = _insert_plan(book, job, plan)
    publish_task = book.connection.scalar(select(tasks.c.seq).where(tasks.c.key == plan.publish_key))
    book.connection.execute(
        update(jobs)
        .where(jobs.c.seq == job)
        .values(builds=plan.builds.model_dump_json(), publish_task=publish_task, reason=None, message="")
    )
    if last is TaskState.succeeded:
        set_job_state(book.connection, job, JobState.queued, book.now, message="all of it was made before: checking it")
        return
    charge_waiting_tasks(book.connection, job)  # tasks that it shares with paused jobs run for this one
    if _has_started_tasks(book.connection, job):
        set_job_state(book.connection, job, JobState.running, book.now)


def _has_started_tasks(connection: Connection, job: int) -> bool:
    query = select(func.sum(job_counts.c.count)).where(
        job_counts.c.job == job, job_counts.c.state.in_((TaskState.leased, TaskState.running))
    )
    return bool(connection.scalar(query))


class _Known(NamedTuple):
    """A task that was in the database before the job."""

    seq: int
    stage: Stage
    state: TaskState
    reason: str | None
    message: str
    cost_group: str


def _insert_plan(book: Ledger, job: int, plan: Plan) -> TaskState:
    """Write the tasks of `job` and return the state of the last of them."""
    connection = book.connection
    known = _find(connection, plan.tasks)
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
    book.inserted.update(counts)
    counts.update((task.stage, task.state) for task in known.values())
    _insert_counts(connection, job, counts)
    left = Counter((task.stage, task.cost_group) for task in known.values() if task.state not in OVER)
    for key, task in plan.tasks.items():
        if key not in known:
            left[Stage(task.stage), task.cost_group] += seqs[key] not in rejected
    groups = {*left, *((task.stage, task.cost_group) for task in known.values())}
    rows = ((job, stage, group, left[stage, group]) for stage, group in groups)
    insert_rows(connection, job_groups, ("job", "stage", "cost_group", '"left"'), rows)
    _retry(book, job, [task for task in known.values() if task.state in _LOST])  # its moves change the counts
    return known[plan.publish_key].state if plan.publish_key in known else TaskState.pending


def _find(connection: Connection, keys: Iterable[bytes]) -> dict[bytes, _Known]:
    found: dict[bytes, _Known] = {}
    if not connection.scalar(select(tasks.c.seq).limit(1)):
        return found
    columns = (
        tasks.c.key,
        tasks.c.seq,
        tasks.c.stage,
        tasks.c.state,
        tasks.c.reason,
        tasks.c.message,
        tasks.c.cost_group,
    )
    for batch in batches(keys):
        for key, seq, stage, state, *rest in connection.execute(select(*columns).where(tasks.c.key.in_(batch))):
            found[key] = _Known(seq, Stage(stage), TaskState(state), *rest)
    return found


def _retry(book: Ledger, job: int, lost: Sequence[_Known]) -> None:
    """Let failed and cancelled tasks wait for a new try: to submit again is to ask for it."""
    for task in lost:
        book.moved(task.seq, task.stage, task.state, TaskState.pending)
    for batch in batches(lost):
        book.connection.execute(
            update(tasks)
            .where(tasks.c.seq.in_([task.seq for task in batch]))
            .values(
                state=TaskState.pending,
                reason=None,
                message="",
                job=job,
                tries=0,
                losses=0,
                retry_at=None,
                finished_at=None,
            )
        )


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
    for key, (stage, build, payload, depends_on, preview, cost_group) in plan.tasks.items():
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
            elif stage == Stage.render and settled[needed].state is TaskState.rejected:
                fate = ("rejected", settled[needed].reason, settled[needed].message)
                rejected.add(seq)
        if stage in (Stage.pack, Stage.publish):  # their slots are those of the job that came first
            payload = json.dumps(json.loads(payload) | {"job": job})
        rows.append((seq, key, stage, kind, build, payload, preview, cost_group, job, *fate, waiting_on))
    columns = ("seq", "key", "stage", "kind", "build", "payload", "preview", "cost_group", "job")
    insert_rows(connection, tasks, (*columns, "state", "reason", "message", "waiting_on"), rows)
    insert_rows(connection, task_dependencies, ("task", "depends_on"), dependencies)
    return seqs, rejected


def _insert_counts(connection: Connection, job: int, counts: Mapping[tuple[Stage, TaskState], int]) -> None:
    rows = [(job, stage, state, counts.get((stage, state), 0)) for stage in Stage for state in TaskState]
    insert_rows(connection, job_counts, ("job", "stage", "state", "count"), rows)
    settled = (TaskState.succeeded, TaskState.rejected)
    cached = [(job, stage, sum(counts.get((stage, state), 0) for state in settled)) for stage in Stage]
    insert_rows(connection, job_stages, ("job", "stage", "cached"), cached)
