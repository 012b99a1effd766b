"""Insertion of jobs and of their plans, piece by piece.

If a task exists in the database already, jobs share it. If it has a result, the job gets that for
free. If it waits or runs, both jobs wait for it. If it failed, or if no other job needs it any
more, the new job starts it again with all its tries.
"""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple

from sqlalchemy import BindParameter, Connection, bindparam, delete, insert, select, text, update
from stickslip_schemas.base import JobState, Stage, TaskState
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.database.statements import (
    RowQuery,
    Statement,
    ValueQuery,
    batches,
    insert_rows,
)
from stickslip_services.database.tables import (
    job_tasks,
    jobs,
    ready_tasks,
    samples,
    task_dependencies,
    tasks,
)
from stickslip_services.queue.dependents import reject_renders
from stickslip_services.queue.ids import new_id
from stickslip_services.queue.integrity import (
    payload_digest,
    result_digest,
    row_digest,
    sample_digest,
)
from stickslip_services.queue.job_states import set_job_state
from stickslip_services.queue.plan import Plan, PlannedTask
from stickslip_services.queue.ready import add_ready
from stickslip_services.queue.rerun import RESET_ATTEMPTS, add_dependencies, reset_tasks
from stickslip_services.queue.rows import HAS_RESULT, PlanInputs, SampleRow, task_columns
from stickslip_services.queue.transaction import QueueTransaction


def insert_job(tx: QueueTransaction, spec: JobSpec, *, priority: int = 0, project: str = "") -> int:
    """Insert a job without its tasks, and return its `seq`."""
    document = spec.model_dump_json()
    result = tx.connection.execute(
        insert(jobs).values(
            id=new_id("job"),
            name=spec.name,
            project=project,
            kind=spec.kind,
            spec=document,
            digest=row_digest(document, None, None),
            sample_count=spec.sample_count,
            state=JobState.queued,
            message="",
            rejected_count=0,
            priority=priority,
            created_at=tx.now,
        )
    )
    return int(result.inserted_primary_key[0])  # type: ignore[index]  # of one inserted row it is never None


def begin_planning(
    tx: QueueTransaction, job: int, inputs: PlanInputs, plan: Plan | None = None
) -> None:
    """Store the inputs of a job's plan, and insert the plan or leave it to the planner.

    The planner inserts a plan piece by piece if `plan` is None.
    """
    spec = tx.connection.scalar(select(jobs.c.spec).where(jobs.c.seq == job))
    builds = inputs.builds.model_dump_json()
    values = {"builds": builds, "certificate": inputs.certificate}
    values["digest"] = row_digest(spec, builds, inputs.certificate)  # type: ignore[assignment]
    tx.connection.execute(update(jobs).where(jobs.c.seq == job).values(values))
    set_job_state(tx, job, JobState.planning if plan is None else JobState.queued)
    if plan is not None:
        insert_piece(tx, job, plan)


def insert_piece(tx: QueueTransaction, job: int, piece: Plan) -> None:
    """Insert the tasks of a piece of a job, and end the planning with the last piece.

    If the dataset exists already, the job ends once the dataset has been checked
    (`existing_datasets`).
    """
    known = _insert_plan(tx, job, piece)
    is_job = jobs.c.seq == job
    tx.connection.execute(update(jobs).where(is_job).values(planned=piece.end))
    key = piece.publish_key
    if key is None:
        return
    publish_task = tx.connection.scalar(select(tasks.c.seq).where(tasks.c.key == key))
    # The plan is complete, so the claim of the planner ends with it.
    planned = {"publish_task": publish_task, "planner": None, "planner_until": None}
    tx.connection.execute(update(jobs).where(is_job).values(planned))
    # A dataset in the database may be damaged in the store, so it is checked before the job ends.
    if key in known and known[key].state == TaskState.succeeded:
        message = "the dataset exists already: its files are being checked"
        set_job_state(tx, job, JobState.queued, message=message)
        return
    row = tx.connection.execute(select(jobs.c.state, jobs.c.started_at).where(is_job)).one()
    if row.state == JobState.planning:
        # Workers may have run tasks of earlier pieces during the planning.
        started = row.started_at is not None
        set_job_state(tx, job, JobState.running if started else JobState.queued)


# ---- Tasks ---------------------------------------------------------------------------------------


class _KnownTask(NamedTuple):
    """A task that the database had before the piece."""

    seq: int
    stage: str
    key: bytes
    state: str
    reason: str | None
    message: str
    cost_group: str
    tries: int
    losses: int


_ANY_TASK: ValueQuery[int] = ValueQuery("SELECT seq FROM tasks LIMIT 1")
_LAST_TASK: ValueQuery[int] = ValueQuery("SELECT max(seq) FROM tasks")
_KNOWN_TASKS = RowQuery(
    _KnownTask,
    select(*task_columns(_KnownTask)).where(tasks.c.key.in_(bindparam("b_keys", expanding=True))),
)
_TASKS: BindParameter[int] = bindparam("b_tasks", expanding=True)
_TASKS_OF_JOB: ValueQuery[int] = ValueQuery(
    text("SELECT task FROM job_tasks WHERE job = :b_job AND task IN :b_tasks").bindparams(_TASKS)
)
_NEEDED_TASKS: ValueQuery[int] = ValueQuery(
    text(
        "SELECT DISTINCT job_tasks.task FROM job_tasks JOIN jobs ON jobs.seq = job_tasks.job "
        "WHERE job_tasks.task IN :b_tasks AND jobs.finished_at IS NULL "
        "AND jobs.state != 'cancelling'"
    ).bindparams(_TASKS)
)


class _Edge(NamedTuple):
    task: int
    depends_on: int


_EDGES = RowQuery(
    _Edge,
    text("SELECT task, depends_on FROM task_dependencies WHERE task IN :b_tasks").bindparams(
        _TASKS
    ),
)
_RESET_WAITING = Statement(
    update(tasks)
    .where(tasks.c.seq == bindparam("b_seq"))
    .values(state=TaskState.pending.value, retry_at=None, **RESET_ATTEMPTS)
)
_REWRITE = Statement(
    update(tasks)
    .where(tasks.c.seq == bindparam("b_seq"))
    .values(
        payload=bindparam("b_payload"),
        build=bindparam("b_build"),
        payload_digest=bindparam("b_payload_digest"),
    )
)


def _insert_plan(tx: QueueTransaction, job: int, plan: Plan) -> dict[bytes, _KnownTask]:
    """Insert the tasks and samples of a piece, and return the tasks that were known before."""
    connection = tx.connection
    known = _find_known(connection, plan)
    # Pieces of one job may share tasks. Such a task is linked and counted once.
    earlier: set[int] = set()  # of earlier pieces of this job
    restarted: list[_KnownTask] = []
    if known:
        seqs = [task.seq for task in known.values()]
        earlier = set(_TASKS_OF_JOB.values(connection, {"b_job": job, "b_tasks": seqs}))
        shared = [task for task in known.values() if task.seq not in earlier]
        restarted = _restart(tx, job, plan, shared)
        # The restart has changed states that the next steps read.
        if restarted:
            known = _find_known(connection, plan)

    new = _NewTasks(job, plan, known)
    new.insert(connection)
    _rewire(tx, plan, new.seqs, restarted)
    _insert_links(connection, job, plan, new, earlier)
    _insert_samples(connection, job, plan, new.seqs)

    # Shared tasks that can run now enter the queue of this job too.
    shared_seqs = [task.seq for task in known.values() if task.seq not in earlier]
    if shared_seqs:
        add_ready(connection, shared_seqs)
    return known


def _find_known(connection: Connection, plan: Plan) -> dict[bytes, _KnownTask]:
    """Return the tasks of a piece and their dependencies that the database has, by key."""
    if _ANY_TASK.first(connection) is None:
        return {}
    # A dependency may be in an earlier piece: the publish task needs the pack tasks of all pieces.
    keys = set(plan.tasks)
    for task in plan.tasks.values():
        keys.update(task.depends_on)
    rows = _KNOWN_TASKS.batched_rows(connection, "b_keys", keys)
    return {row.key: row for row in rows}


def _restart(
    tx: QueueTransaction, job: int, plan: Plan, shared: Iterable[_KnownTask]
) -> list[_KnownTask]:
    """Give shared tasks that failed, or that nobody needs any more, all their tries.

    Writes their rows anew if these may be damaged or name another job. Returns these tasks.
    """
    failed = [task for task in shared if task.state == TaskState.failed]
    waiting = [task for task in shared if task.state in (TaskState.pending, TaskState.soft_failed)]
    # A task that another job waits for keeps its count of failed tries.
    needed = set(_NEEDED_TASKS.values(tx.connection, {"b_tasks": [t.seq for t in waiting]}))
    abandoned = [task for task in waiting if task.seq not in needed]

    rewritten: list[dict[str, object]] = []
    for task in (*failed, *abandoned):
        # Pack and publish tasks read the slots of the job that they name, and that job may be gone.
        names_a_job = task.stage in (Stage.pack, Stage.publish)
        if task.key in plan.tasks and (names_a_job or task.state == TaskState.failed):
            planned = plan.tasks[task.key]
            payload = _payload(planned, job)
            digest = payload_digest(task.key, planned.stage, planned.build, payload)
            row = {"b_seq": task.seq, "b_payload": payload, "b_build": planned.build}
            rewritten.append({**row, "b_payload_digest": digest})
    _REWRITE.run_all(tx.connection, rewritten)

    stale: list[dict[str, object]] = []
    for task in abandoned:
        if task.tries or task.losses or task.state == TaskState.soft_failed:
            stale.append({"b_seq": task.seq})
    _RESET_WAITING.run_all(tx.connection, stale)

    if failed:
        reset_tasks(tx, [task.seq for task in failed])
        # A failed render may belong to a simulation that was rejected before. Then it must not run
        # again.
        reject_renders(tx, [t.seq for t in shared if t.state == TaskState.rejected])
    return [*failed, *abandoned]


def _rewire(
    tx: QueueTransaction, plan: Plan, seqs: Mapping[bytes, int], restarted: Iterable[_KnownTask]
) -> None:
    """Restore the dependencies of restarted tasks that lack tasks of the plan.

    The key of a dependency may have been damaged. Then the plan has another task in its place.
    """
    expected: dict[int, set[int]] = {}
    for task in restarted:
        if task.key in plan.tasks:
            expected[task.seq] = {seqs[key] for key in plan.tasks[task.key].depends_on}
    # More dependencies than the plan has are right: a task may wait for the producers of its
    # inputs.
    actual: dict[int, set[int]] = {seq: set() for seq in expected}
    for edge in _EDGES.batched_rows(tx.connection, "b_tasks", expected):
        actual[edge.task].add(edge.depends_on)
    wrong = [seq for seq in expected if not expected[seq] <= actual[seq]]
    if not wrong:
        return
    for batch in batches(wrong):
        edges = delete(task_dependencies).where(task_dependencies.c.task.in_(batch))
        tx.connection.execute(edges)
        tx.connection.execute(update(tasks).where(tasks.c.seq.in_(batch)).values(waiting_on=0))
    # Without edges each task waits for nothing. This counts its missing results anew.
    for seq in wrong:
        add_dependencies(tx, seq, sorted(expected[seq]))


class _NewTasks:
    """The tasks of a piece that the database does not have yet."""

    def __init__(self, job: int, plan: Plan, known: Mapping[bytes, _KnownTask]) -> None:
        self._job = job
        self._plan = plan
        self.known = known
        self._with_result = {t.seq: t for t in known.values() if t.state in HAS_RESULT}
        self.seqs = {key: task.seq for key, task in known.items()}
        """The `seq` of every task of the piece."""
        self.rejected: set[int] = set()
        """New renders whose simulation was rejected before.

        This rejection is their result.
        """
        self._rows: list[tuple[object, ...]] = []
        self._dependencies: list[tuple[int, int]] = []
        self._ready: list[tuple[int, int, str, str]] = []

    def insert(self, connection: Connection) -> None:
        """Insert the tasks in the order of the plan, with their dependencies and queue entries."""
        # The transaction excludes other writers, so the numbers can be given here, without a query
        # a task.
        seq = _LAST_TASK.first(connection) or 0
        for key, task in self._plan.tasks.items():
            if key not in self.seqs:
                seq += 1
                self.seqs[key] = seq
                self._add(seq, key, task)
        insert_rows(connection, tasks, _TASK_COLUMNS, self._rows)
        insert_rows(connection, task_dependencies, ("task", "depends_on"), self._dependencies)
        columns = ("task", "job", "stage", "cost_group")
        insert_rows(connection, ready_tasks, columns, self._ready)

    def _add(self, seq: int, key: bytes, task: PlannedTask) -> None:
        stage, build, _, depends_on, preview, cost_group = task
        waiting_on = 0
        rejection: _KnownTask | None = None
        for needed_key in depends_on:
            needed = self.seqs[needed_key]
            self._dependencies.append((seq, needed))
            if needed in self.rejected:
                continue
            result = self._with_result.get(needed)
            if result is None:
                waiting_on += 1
            # A render of a rejected simulation would have nothing to render.
            elif stage == Stage.render and result.state == TaskState.rejected:
                rejection = result
        payload = _payload(task, self._job)
        digest = payload_digest(key, stage, build, payload)
        row = (seq, key, stage, self._plan.spec.kind, build, payload, digest, preview, cost_group)
        if rejection is None:
            self._rows.append((*row, "pending", None, "", None, waiting_on))
            if waiting_on == 0:
                self._ready.append((seq, self._job, stage, cost_group))
        else:
            self.rejected.add(seq)
            result_of_task = ("rejected", rejection.reason, rejection.message)
            result_row = (*result_of_task, result_digest(key, *result_of_task, None))
            self._rows.append((*row, *result_row, waiting_on))


_TASK_COLUMNS = (
    "seq",
    "key",
    "stage",
    "kind",
    "build",
    "payload",
    "payload_digest",
    "preview",
    "cost_group",
    "state",
    "reason",
    "message",
    "digest",
    "waiting_on",
)


def _payload(task: PlannedTask, job: int) -> str:
    """Return the document of a task.

    A pack or publish task reads the slots of a job, so its document names the job that came first.
    """
    if task.stage in (Stage.pack, Stage.publish):
        return json.dumps({**json.loads(task.payload), "job": job})
    return task.payload


# ---- Links, totals and samples -------------------------------------------------------------------


def _insert_links(
    connection: Connection, job: int, plan: Plan, new: _NewTasks, earlier: set[int]
) -> None:
    """Insert the tasks that a job needs, and add them to its totals."""
    known = new.known
    links: list[tuple[int, int, bool]] = []
    counts = Counter[tuple[str, str, str]]()
    for key, seq in new.seqs.items():
        # An earlier piece has linked and counted it.
        if seq in earlier:
            continue
        task = known.get(key)
        if task is not None:
            stage, cost_group, state = task.stage, task.cost_group, task.state
        else:
            planned = plan.tasks[key]
            stage, cost_group = planned.stage, planned.cost_group
            state = "rejected" if seq in new.rejected else "pending"
        links.append((job, seq, state in HAS_RESULT))
        counts[stage, cost_group, state] += 1
    insert_rows(connection, job_tasks, ("job", "task", "cached"), links)
    _add_to_totals(connection, job, counts)


_ADD_TO_TOTALS = Statement(
    "INSERT INTO job_totals (job, stage, cost_group, total, cached, succeeded, rejected, failed) "
    "VALUES (:b_job, :b_stage, :b_group, :b_total, :b_cached, :b_succeeded, :b_rejected, "
    ":b_failed) "
    "ON CONFLICT (job, stage, cost_group) DO UPDATE SET "
    "total = job_totals.total + excluded.total, cached = job_totals.cached + excluded.cached, "
    "succeeded = job_totals.succeeded + excluded.succeeded, "
    "rejected = job_totals.rejected + excluded.rejected, "
    "failed = job_totals.failed + excluded.failed"
)


def _add_to_totals(
    connection: Connection, job: int, counts: Mapping[tuple[str, str, str], int]
) -> None:
    """Add planned tasks to the totals of a job: counts by stage, cost group and state."""
    totals: dict[tuple[str, str], Counter[str]] = {}
    for (stage, cost_group, state), count in counts.items():
        total = totals.setdefault((stage, cost_group), Counter())
        total["total"] += count
        total[state] += count
    rows: list[dict[str, object]] = []
    for (stage, cost_group), total in totals.items():
        succeeded = total[TaskState.succeeded]
        rejected = total[TaskState.rejected]
        rows.append(
            {
                "b_job": job,
                "b_stage": stage,
                "b_group": cost_group,
                "b_total": total["total"],
                "b_cached": succeeded + rejected,
                "b_succeeded": succeeded,
                "b_rejected": rejected,
                "b_failed": total[TaskState.failed],
            }
        )
    _ADD_TO_TOTALS.run_all(connection, rows)


def _insert_samples(
    connection: Connection, job: int, plan: Plan, seqs: Mapping[bytes, int]
) -> None:
    rows: list[tuple[object, ...]] = []
    for slot, key, simulate, render, split, labels in plan.samples:
        render_task = None if render is None else seqs[render]
        digest = sample_digest(job, slot, key, seqs[simulate], render_task, split, labels)
        rows.append((job, slot, key, seqs[simulate], render_task, split, labels, digest))
    insert_rows(connection, samples, SampleRow._fields, rows)
