"""Inserting a job and its plan into the database.

A task that exists already is shared. If it is settled, the job gets its result for free; if it waits or runs, both jobs
wait for it; if it failed or was cancelled, the new job starts it again.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import Connection, func, insert, select, update
from stickslip_schemas.base import JobState, Stage, TaskState
from stickslip_schemas.spec.jobs import JobSpec

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
from stickslip_services.queue.ids import SAMPLE_COLUMNS, new_id, row_digest
from stickslip_services.queue.ledger import (
    FRESH,
    JOB_COUNTS,
    JOB_GROUPS,
    OVER,
    SETTLED,
    TASK,
    TASK_COUNTS,
    Ledger,
    reassign,
)
from stickslip_services.queue.plan import Plan, PlannedTask, Terms

_LOST = (TaskState.failed, TaskState.cancelled)


def insert_job(book: Ledger, spec: JobSpec, *, priority: int = 0, project: str = "") -> int:
    """Insert a job without its tasks; return its `seq`."""
    text = spec.model_dump_json()
    result = book.connection.execute(
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
            created_at=book.now,
        )
    )
    return int(result.inserted_primary_key[0])  # type: ignore[index]  # of one inserted row it is never None


def begin_planning(book: Ledger, job: int, terms: Terms, plan: Plan | None = None) -> None:
    """Store the terms of a job, start its counters, and write its whole plan, or have it planned piece by piece."""
    spec = book.connection.scalar(select(jobs.c.spec).where(jobs.c.seq == job))
    values = {"builds": terms.builds.model_dump_json(), "certificate": terms.certificate}
    digest = row_digest(spec, *values.values())
    book.connection.execute(update(jobs).where(jobs.c.seq == job).values(values | {"digest": digest}))
    rows = [(job, stage, state, 0) for stage in Stage for state in TaskState]
    insert_rows(book.connection, job_counts, ("job", "stage", "state", "count"), rows)
    insert_rows(book.connection, job_stages, ("job", "stage", "cached"), [(job, stage, 0) for stage in Stage])
    book.set_state(job, JobState.planning if plan is None else JobState.queued)
    if plan is not None:
        write_plan(book, job, plan)


def write_plan(book: Ledger, job: int, piece: Plan) -> None:
    """Insert the tasks of a piece of a job; the last piece makes a `planning` job `queued`.

    If its dataset exists already, the job ends once the dataset has been checked (`recompute`).
    """
    last = _insert_plan(book, job, piece)
    book.connection.execute(update(jobs).where(jobs.c.seq == job).values(planned=piece.end))
    if not piece.is_last:
        return
    publish_task = book.connection.scalar(select(tasks.c.seq).where(tasks.c.key == piece.publish_key))
    done = {"publish_task": publish_task, "planner": None, "planner_until": None}
    book.connection.execute(update(jobs).where(jobs.c.seq == job).values(done))
    if last == TaskState.succeeded:
        message = "the dataset exists already: its files are being checked"
        book.set_state(job, JobState.queued, message=message)
    elif book.connection.scalar(select(jobs.c.state).where(jobs.c.seq == job)) == JobState.planning:
        book.set_state(job, JobState.queued)


_KNOWN = [*TASK, *(tasks.c[name] for name in ("key", "reason", "message", "cost_group"))]
"""Columns of tasks that were in the database before the piece."""


def _insert_plan(book: Ledger, job: int, plan: Plan) -> str:
    """Insert the tasks of `job`; return the state of the last one."""
    connection = book.connection
    needed = {key for task in plan.tasks.values() for key in task.depends_on} - plan.tasks.keys()
    known = _find(connection, [*plan.tasks, *needed])
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
            for row in [(job, slot, key, seqs[simulate], None if render is None else seqs[render], split, labels)]
        ),
    )
    new = Counter(
        (task.stage, task.cost_group, TaskState.rejected if seqs[key] in rejected else TaskState.pending)
        for key, task in plan.tasks.items()
        if key not in known
    )
    overall = Counter[Any]()
    for (stage, _, state), count in new.items():
        overall[stage, state] += count
    TASK_COUNTS.add(connection, overall)
    _add_counts(connection, job, new + Counter((task.stage, task.cost_group, task.state) for task in shared))
    lost = [task for task in shared if task.state in _LOST]
    book.move(lost, TaskState.pending, **FRESH)  # which changes the counts
    for key, old in known.items():
        if old.state in _LOST and key in plan.tasks:  # its row may have been damaged
            values = {"payload": _payload(plan.tasks[key], job), "build": plan.tasks[key].build}
            connection.execute(update(tasks).where(tasks.c.seq == old.seq).values(values))
    reassign(book, [task for task in shared if task.state not in SETTLED])
    return known[plan.publish_key].state if plan.is_last and plan.publish_key in known else TaskState.pending


def _find(connection: Connection, keys: Iterable[bytes]) -> dict[bytes, Any]:
    if not connection.scalar(select(tasks.c.seq).limit(1)):
        return {}
    return {row.key: row for row in rows_with(connection, select(*_KNOWN), tasks.c.key, keys)}


def _insert_tasks(
    connection: Connection, job: int, plan: Plan, known: Mapping[bytes, Any]
) -> tuple[dict[bytes, int], set[int]]:
    """Insert the tasks that are new, in the order of the plan.

    Return the `seq` of every task of the plan, and those of new renders whose simulation has been rejected before.
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
        rows.append((seq, key, stage, kind, build, _payload(task, job), preview, cost_group, job, *fate, waiting_on))
    columns = ("seq", "key", "stage", "kind", "build", "payload", "preview", "cost_group", "job")
    insert_rows(connection, tasks, (*columns, "state", "reason", "message", "digest", "waiting_on"), rows)
    insert_rows(connection, task_dependencies, ("task", "depends_on"), dependencies)
    return seqs, rejected


def _payload(task: PlannedTask, job: int) -> str:
    """Return the document of a task; the slots of pack and publish are those of the job that came first."""
    if task.stage in (Stage.pack, Stage.publish):
        return json.dumps(json.loads(task.payload) | {"job": job})
    return task.payload


def _add_counts(connection: Connection, job: int, held: Mapping[tuple[str, str, str], int]) -> None:
    """Count tasks that a job has, by stage, cost group and state."""
    counts, left, cached = Counter[Any](), Counter[Any](), Counter[str]()
    for (stage, group, state), count in held.items():
        counts[job, stage, state] += count
        left[job, stage, group] += count * (state not in OVER)
        cached[stage] += count * (state in SETTLED)
    JOB_COUNTS.add(connection, counts)
    JOB_GROUPS.add(connection, left)
    for stage, count in (+cached).items():
        own = (job_stages.c.job == job, job_stages.c.stage == stage)
        connection.execute(update(job_stages).where(*own).values(cached=job_stages.c.cached + count))
