"""How leased tasks end: with results, with failures that are retried, or with the loss of their
worker.

The first result from the holder of the lease is final. A dataset version is committed by the
transaction that accepts the report of its publish task.

Losing a worker does not count as a failed try, and neither does a task that had not been started.
After the n-th failed try the task waits `retry_seconds` 2^(n-1); after `max_tries` of them it
fails. A task that ended its process each time is quarantined, and the jobs that need it continue
with everything else. Any other failure ends all jobs that need the task: they start no further
tasks, and running ones finish and are kept.
"""

import shlex
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from sqlalchemy import Connection, bindparam, delete, func, insert, select, text, update
from stickslip_schemas.base import JobState, Reason, Stage, TaskState
from stickslip_schemas.documents.tasks import PublishOutput, RenderOutput, TaskResult
from stickslip_schemas.documents.worker_api import Report, ReportAnswer, ReportBatch, ReportVerdict
from stickslip_schemas.format.manifest import Manifest, seal_text
from stickslip_schemas.store import is_unavailable

from stickslip_services.catalog.versions import (
    check_output,
    commit_version,
    find_committed,
    find_reserved,
    read_version,
    sign_version,
)
from stickslip_services.client.errors import ClientError
from stickslip_services.database.database import Prepared, RowQuery, batches
from stickslip_services.database.tables import (
    job_counts,
    job_tasks,
    jobs,
    previews,
    task_dependencies,
    tasks,
)
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import row_digest, task_id, task_key
from stickslip_services.queue.recompute import add_dependencies, recompute
from stickslip_services.queue.rows import LeasedTask, Task, TaskRow, columns
from stickslip_services.queue.transaction import (
    IS_LEASED,
    LIVE,
    RUNNABLE,
    SETTLED,
    QueueTransaction,
    reassign,
)
from stickslip_services.queue.workers import find_worker, touch_workers
from stickslip_services.settings import Settings

Ended = tuple[LeasedTask, TaskResult]

_NOTE_REPORT = Prepared(
    update(tasks)
    .where(tasks.c.seq.in_(bindparam("b_tasks", expanding=True)))
    .values(reported_by=bindparam("b_worker"), reported_token=tasks.c.token)
)
_FIND = RowQuery(
    LeasedTask,
    select(*columns(LeasedTask)).where(tasks.c.key.in_(bindparam("b_keys", expanding=True))),
)
_WRITTEN = (
    "state",
    "reason",
    "message",
    "output",
    "digest",
    "cpu_seconds",
    "wall_seconds",
    "finished_at",
)
_SETTLE = Prepared(
    update(tasks)
    .where(tasks.c.seq == bindparam("b_seq"))
    .values(
        {name: bindparam(f"b_{name}") for name in _WRITTEN} | {"owner": None, "expires_at": None}
    )
)
_DEPENDENTS = Prepared(
    select(task_dependencies.c.depends_on, tasks.c.seq, tasks.c.key, tasks.c.stage, tasks.c.state)
    .join(tasks, tasks.c.seq == task_dependencies.c.task)
    .where(task_dependencies.c.depends_on.in_(bindparam("b_tasks", expanding=True)))
)


def report_results(context: Context, batch: ReportBatch) -> ReportAnswer:
    """Judge the reports of a worker, one by one, and store the results; raise UnknownWorkerError."""
    versions: dict[str, Manifest] = {}
    reports = [_checked_in_store(context, report, versions) for report in batch.reports]
    with context.transaction() as tx:
        worker = find_worker(tx.connection, batch.worker_id)
        touch_workers(tx.connection, [worker.id], tx.now)
        verdicts, released, ended = _judged(tx, worker.id, reports, versions)
        requeue(tx, released)
        # Who reports a result has started the task, whether or not a heartbeat said so in between.
        tx.mark_started([task for task, _ in ended if task.state == TaskState.leased])
        ended = [(task._replace(state=TaskState.running), result) for task, result in ended]
        _take_results(
            tx, [(task, result) for task, result in ended if result.outcome != "failed"], versions
        )
        failures: list[tuple[LeasedTask, Reason, str]] = []
        for task, result in ended:
            if result.reason is Reason.store_unavailable:
                context.store_watch.note(
                    f"worker {worker.name} cannot use the store: {result.message}"
                )
                requeue(tx, [task])
            elif result.reason is Reason.worker_lost:
                requeue_lost(tx, [task], context.settings, message=result.message)
            elif result.outcome == "failed":
                failures.append((task, result.reason or Reason.internal_error, result.message))
        record_failures(tx, failures, context.settings)
        for task, result in ended:
            if result.damaged_inputs:
                recompute(tx, task.seq, result.damaged_inputs)
    for verdict in verdicts:
        if verdict.verdict == "accepted" and verdict.task_id in versions:
            with suppress(OSError):
                for digest in context.sections.pop(verdict.task_id, ()):
                    context.store.delete(digest)
    return ReportAnswer(verdicts=tuple(verdicts))


def _checked_in_store(context: Context, report: Report, versions: dict[str, Manifest]) -> Report:
    """Return the report, or a failure where the store lacks its artifacts.

    Add the summary of a manifest, signed.
    """
    if report.result is None or report.result.output is None:
        return report
    output = report.result.output
    try:
        if isinstance(output, PublishOutput):
            version = read_version(context.store, output)
            if context.settings.signing_key is not None:
                seal = seal_text(output.manifest, output.group)
                sign_version(
                    context.store,
                    version.dataset,
                    version.version,
                    seal,
                    context.settings.signing_key,
                )
            versions[report.task_id] = version
        else:
            check_output(context.store, output)
    except (OSError, ValueError, ClientError) as error:
        unavailable = isinstance(error, OSError) and is_unavailable(error)
        reason = Reason.store_unavailable if unavailable else Reason.storage_error
        return report.model_copy(
            update={"result": _failed(report.result, reason, f"the result does not hold: {error}")}
        )
    return report


def _failed(result: TaskResult, reason: Reason, message: str) -> TaskResult:
    update = {"outcome": "failed", "reason": reason, "message": message[:2000], "output": None}
    return result.model_copy(update=update)


def _judged(
    tx: QueueTransaction, worker_id: str, reports: Sequence[Report], versions: dict[str, Manifest]
) -> tuple[list[ReportVerdict], list[LeasedTask], list[Ended]]:
    """Judge each report.

    Return the verdicts, the tasks that were given back, and those that have ended.

    `versions` has the summaries of manifests by publish task; they were read before the
    transaction.
    """
    verdicts: list[ReportVerdict] = []
    released: list[LeasedTask] = []
    ended: list[Ended] = []
    keys = {key for report in reports if (key := task_key(report.task_id)) is not None}
    found = (row for batch in batches(keys) for row in _FIND.rows(tx.connection, {"b_keys": batch}))
    rows = {task_id(row.stage, row.key): row for row in found}
    for report in reports:
        row, mine = rows.get(report.task_id), (worker_id, report.token)
        if row is not None and (row.reported_by, row.reported_token) == mine:
            verdicts.append(ReportVerdict(task_id=report.task_id, verdict="duplicate"))
        elif row is None or (row.owner, row.token) != mine:
            verdicts.append(ReportVerdict(task_id=report.task_id, verdict="stale"))
        else:
            verdicts.append(ReportVerdict(task_id=report.task_id, verdict="accepted"))
            rows[report.task_id] = row._replace(
                owner=None, reported_by=worker_id, reported_token=report.token
            )
            if report.result is None:
                released.append(row)
            else:
                ended.append((row, _checked(tx, row, report.result, versions)))
    for batch in batches([*released, *(task for task, _ in ended)]):
        _NOTE_REPORT.run(
            tx.connection, {"b_tasks": [task.seq for task in batch], "b_worker": worker_id}
        )
    return verdicts, released, ended


def _checked(
    tx: QueueTransaction, task: LeasedTask, result: TaskResult, versions: dict[str, Manifest]
) -> TaskResult:
    """Return the result, or a failure where it does not fit the task."""
    if result.output is not None and result.output.stage != task.stage:
        wrong = f"the worker answered with the output of stage {result.output.stage}"
        return _failed(result, Reason.internal_error, wrong)
    if result.outcome == "rejected" and task.stage in (Stage.pack, Stage.publish):
        wrong = f"the worker rejected a {task.stage} task, which has no sample to reject: {result.message}"
        return _failed(result, Reason.internal_error, wrong)
    if result.output is not None and task.stage == Stage.publish:
        reserved, version = (
            find_reserved(tx.connection, task.seq),
            versions.get(task_id(task.stage, task.key)),
        )
        if version is None or (version.dataset, version.version) != reserved:
            return _failed(result, Reason.storage_error, f"the manifest is not that of {reserved}")
    return result


def _take_results(
    tx: QueueTransaction, settled: Sequence[Ended], versions: dict[str, Manifest]
) -> None:
    """Store results, release the tasks that depend on them, and commit versions."""
    written = []
    rejected: dict[int, tuple[Reason, str]] = {}
    for task, result in settled:
        output = None if result.output is None else result.output.model_dump_json()
        costs = {"b_cpu_seconds": result.cpu_seconds, "b_wall_seconds": result.wall_seconds}
        written.append(
            _written(tx, task, result.outcome, result.reason, result.message, output) | costs
        )
        tx.record_transition([task], TaskState(result.outcome))
        tx.record_cost(task, result)
        if result.reason is not None:
            rejected[task.seq] = (result.reason, result.message)
            tx.emit_task_event(task, TaskState.rejected, *rejected[task.seq])
    _SETTLE.run_all(tx.connection, written)
    _release_dependents(tx, [task.seq for task, _ in settled], rejected)
    for task, result in settled:
        if isinstance(result.output, RenderOutput) and result.output.preview is not None:
            tx.connection.execute(
                delete(previews).where(previews.c.task == task.seq)
            )  # of an earlier run
            tx.connection.execute(
                insert(previews).values(task=task.seq, digest=result.output.preview)
            )
        elif isinstance(result.output, PublishOutput):
            _commit(tx, task.seq, versions[task_id(task.stage, task.key)], result.output)


def _commit(
    tx: QueueTransaction, publish_task: int, manifest: Manifest, output: PublishOutput
) -> None:
    """Commit a version, and end the jobs that wait for it."""
    connection = tx.connection
    of_task = (jobs.c.seq.in_(tx.open_jobs_of(publish_task)), jobs.c.state.in_(LIVE))
    waiting = connection.execute(
        select(jobs.c.seq, jobs.c.name).where(*of_task).order_by(jobs.c.seq)
    ).all()
    name = next((row.name for row in waiting if row.name is not None), None)
    commit_version(connection, publish_task, manifest, output, name=name, now=tx.now)
    for row in waiting:
        tx.complete_job(row.seq, find_committed(connection, publish_task))


def _written(
    tx: QueueTransaction,
    task: Any,
    state: str,
    reason: Reason | None,
    message: str,
    output: str | None,
) -> dict[str, Any]:
    """Return the parameters of `_SETTLE` for a task whose run took no time."""
    made = {"b_state": state, "b_reason": reason, "b_message": message, "b_output": output}
    free = {"b_cpu_seconds": None, "b_wall_seconds": None, "b_finished_at": tx.now}
    return {"b_seq": task.seq, **made, "b_digest": row_digest(task.key, *made.values()), **free}


def _release_dependents(
    tx: QueueTransaction, settled: Sequence[int], rejected: dict[int, tuple[Reason, str]]
) -> None:
    """Decrement `waiting_on` of dependents.

    A rejected simulation rejects its renders, which settles them in turn.
    """
    edges = [
        edge
        for batch in batches(settled)
        for edge in _DEPENDENTS.rows(tx.connection, {"b_tasks": batch})
    ]
    if not edges:
        return
    add_dependencies(
        tx, {seq: -count for seq, count in Counter(edge.seq for edge in edges).items()}
    )
    doomed = [
        edge
        for edge in edges
        if edge.stage == Stage.render and edge.depends_on in rejected and edge.state not in SETTLED
    ]
    why = [
        _written(tx, edge, TaskState.rejected, *rejected[edge.depends_on], None) for edge in doomed
    ]
    _SETTLE.run_all(tx.connection, why)
    tx.record_transition(doomed, TaskState.rejected)
    _release_dependents(tx, [edge.seq for edge in doomed], {})


_LEASED_TASKS = RowQuery(
    LeasedTask,
    select(*columns(LeasedTask)).where(
        IS_LEASED, tasks.c.owner.in_(bindparam("b_owners", expanding=True))
    ),
)


def leased_tasks_of(connection: Connection, owners: Sequence[str]) -> list[LeasedTask]:
    """Return the tasks that some workers hold."""
    return _LEASED_TASKS.rows(connection, {"b_owners": owners})


def requeue(tx: QueueTransaction, held: Sequence[TaskRow], **values: Any) -> None:
    """Return tasks to `pending`, with other values of their columns.

    Cancel those that no live job needs.
    """
    tx.set_task_state(reassign(tx, held), TaskState.pending, **values)


def requeue_lost(
    tx: QueueTransaction, held: Sequence[LeasedTask], settings: Settings, *, message: str
) -> None:
    """Take back the leases of a lost worker. A task fails after `max_losses` lost workers."""
    started = [task for task in held if task.state == TaskState.running]
    requeue(tx, [task for task in held if task.state == TaskState.leased])
    requeue(
        tx,
        [task for task in started if task.losses + 1 < settings.max_losses],
        losses=tasks.c.losses + 1,
    )
    for task in started:
        if task.losses + 1 >= settings.max_losses and reassign(tx, [task]):
            _fail(tx, task, Reason.worker_lost, message, task.losses + 1, settings)


def record_failures(
    tx: QueueTransaction, failures: Sequence[tuple[LeasedTask, Reason, str]], settings: Settings
) -> None:
    """Count failed tries; each task is retried later, or fails for good."""
    for task, reason, message in failures:
        tries = task.tries + 1
        if not reassign(tx, [task]):
            continue
        if tries >= settings.max_tries:
            _fail(tx, task, reason, message, tries, settings)
            continue
        retry_at = tx.now + settings.retry_seconds * 2 ** (tries - 1)
        why: dict[str, Any] = {"reason": reason, "message": message}
        tx.set_task_state([task], TaskState.soft_failed, tries=tries, retry_at=retry_at, **why)
        tx.emit_task_event(task, TaskState.soft_failed, **why)


def _fail(
    tx: QueueTransaction,
    task: LeasedTask,
    reason: Reason,
    message: str,
    times: int,
    settings: Settings,
) -> None:
    """Let a task fail for good after `times` failures or losses, and quarantine it or end its jobs."""
    name = task_id(task.stage, task.key)
    command = reproducer(name, settings)
    why = f"task {name} failed {times} times, at last with {reason}: {message}"
    tries = task.tries + (reason is not Reason.worker_lost)
    if is_quarantined := reason.ends_a_process:
        message = (
            f"quarantined after {times} tries, at last {reason}: {message}. To reproduce: {command}"
        )
        reason = Reason.quarantined
    tx.set_task_state([task], TaskState.failed, tries=tries, reason=reason, message=message)
    tx.emit_task_event(task, TaskState.failed, reason, message)
    tx.flush_counters()
    for job in tx.open_jobs_of(task.seq):
        state, failed = tx.connection.execute(_FAILED.where(jobs.c.seq == job)).one()
        if is_quarantined and failed <= settings.max_quarantined:
            if state in RUNNABLE:
                news = f"task {name} was {message}. The job goes on with the others"
                tx.set_job_state(job, JobState(state), reason=reason, message=news)
            continue
        if is_quarantined:
            why = f"{failed} of its tasks were quarantined, at last {name}: {message}"
        kept = "No further tasks are started; what is done is kept, and submitting the job again tries again"
        tx.end_job(
            job, JobState.failed, Reason.failed_tasks, f"{why}. {kept}. To reproduce: {command}"
        )


_FAILED = (
    select(
        jobs.c.state, func.sum(job_counts.c.count).filter(job_counts.c.state == TaskState.failed)
    )
    .join(job_counts, job_counts.c.job == jobs.c.seq)
    .group_by(jobs.c.seq)
)

# A lease ends when it has had its duration, and nothing has been heard of its worker for as long.
_EXPIRED = (
    f"{IS_LEASED.text} AND tasks.expires_at <= :b_now "
    "AND tasks.owner NOT IN (SELECT workers.id FROM workers WHERE workers.last_seen_at > :b_alive_since)"
)
_DUE = "tasks.state = 'soft_failed' AND tasks.retry_at <= :b_now"
_FIND_EXPIRED = RowQuery(LeasedTask, select(*columns(LeasedTask)).where(text(_EXPIRED)))
_FIND_DUE = RowQuery(Task, select(*columns(Task)).where(text(_DUE)))
_IS_DUE = Prepared(
    f"SELECT EXISTS (SELECT 1 FROM tasks WHERE {_EXPIRED}) OR EXISTS (SELECT 1 FROM tasks WHERE {_DUE})"
)


def is_expiry_due(connection: Connection, now: float, alive_since: float) -> bool:
    """Return whether a lease has expired or a retry is due, without taking the write lock."""
    return bool(_IS_DUE.scalar(connection, {"b_now": now, "b_alive_since": alive_since}))


def expire_leases(context: Context) -> None:
    """Take back expired leases, and return tasks whose retry is due to `pending`."""
    with context.database.read() as connection:
        if not is_expiry_due(connection, context.clock(), context.alive_since):
            return
    seconds = context.settings.lease_seconds
    with context.transaction() as tx:
        expired = _FIND_EXPIRED.rows(
            tx.connection, {"b_now": tx.now, "b_alive_since": tx.now - seconds}
        )
        requeue_lost(tx, expired, context.settings, message=f"no heartbeat for {seconds:g} s")
        tx.set_task_state(_FIND_DUE.rows(tx.connection, {"b_now": tx.now}), TaskState.pending)


def reproducer(name: str, settings: Settings) -> str:
    """Return the shell command that runs a task alone, on a machine with a worker's environment."""
    fetch = f"curl -s {settings.url}/v1/tasks/{name} -o task.json"
    return f"{fetch} && python -m stickslip_workers replay task.json --store {shlex.quote(settings.store_place)}"


def failed_tasks(
    connection: Connection, job: int, settings: Settings, count: int
) -> list[dict[str, Any]]:
    """Return the tasks of a job that have failed or wait for a retry, newest first, with names and
    reproducers.
    """
    rows = connection.execute(
        select(tasks.c.key, tasks.c.stage, tasks.c.tries, tasks.c.reason, tasks.c.message)
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.state.in_((TaskState.failed, TaskState.soft_failed)))
        .order_by(tasks.c.seq.desc())
        .limit(count)
    )
    return [
        {
            **row,
            "task_id": (name := task_id(row.stage, row.key)),
            "reproducer": reproducer(name, settings),
        }
        for row in rows.mappings()
    ]
