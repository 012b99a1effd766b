"""Reports of workers: verdicts, results, and their consequences.

The first result from the holder of the lease is final. The transaction that accepts the report of a
publish task also commits the dataset version. `failures` ends the leases without a result.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

from sqlalchemy import bindparam, delete, insert, select, text, update
from stickslip_schemas.base import Reason, Stage, TaskState
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
from stickslip_services.database.statements import RowQuery, Statement, batches
from stickslip_services.database.tables import previews, tasks
from stickslip_services.queue.context import Context
from stickslip_services.queue.dependents import release_dependents
from stickslip_services.queue.eta import Run, add_costs
from stickslip_services.queue.failures import (
    NO_LEASE,
    Failure,
    mark_started,
    record_failures,
    requeue,
    requeue_lost,
)
from stickslip_services.queue.ids import task_id, task_key
from stickslip_services.queue.integrity import result_digest
from stickslip_services.queue.job_states import complete_job, emit_task_event
from stickslip_services.queue.rerun import rerun_producers
from stickslip_services.queue.rows import LeasedTask, task_columns
from stickslip_services.queue.totals import add_results
from stickslip_services.queue.transaction import QueueTransaction
from stickslip_services.queue.workers import find_worker, touch_workers

MAX_MESSAGE = 2000
"""Length of the message of a failure [characters]."""

Versions = Mapping[str, Manifest]
"""Summaries of the manifests of reported versions, by publish task."""


class EndedTask(NamedTuple):
    """A task whose worker has reported how its attempt ended."""

    task: LeasedTask
    result: TaskResult


@dataclass(slots=True)
class _Judgement:
    """The verdicts on a batch of reports, and the tasks of the accepted ones."""

    verdicts: list[ReportVerdict] = field(default_factory=list)
    released: list[LeasedTask] = field(default_factory=list)
    """Returned without an attempt."""
    ended: list[EndedTask] = field(default_factory=list)


def report_results(context: Context, batch: ReportBatch) -> ReportAnswer:
    """Judge the reports of a worker, and store the results.

    Raises UnknownWorkerError.
    """
    # The store may answer slowly, so it is asked before the transaction.
    versions: dict[str, Manifest] = {}
    reports = [_check_in_store(context, report, versions) for report in batch.reports]

    with context.transaction() as tx:
        worker = find_worker(tx.connection, batch.worker_id)
        touch_workers(tx.connection, [worker.id], tx.now)
        judgement = _judge(tx, worker.id, reports, versions)
        requeue(tx, judgement.released)

        # A worker that reports a result has started the task, whether or not a heartbeat said so in
        # between.
        mark_started(
            tx, [ended.task for ended in judgement.ended if ended.task.state == TaskState.leased]
        )
        settled = [ended for ended in judgement.ended if ended.result.outcome != "failed"]
        _store_results(tx, settled, versions)
        _end_failed_attempts(context, tx, worker.name, judgement.ended)
        for ended in judgement.ended:
            if ended.result.damaged_inputs:
                rerun_producers(tx, ended.task.seq, ended.result.damaged_inputs)

    _delete_sections(context, judgement.verdicts, versions)
    return ReportAnswer(verdicts=tuple(judgement.verdicts))


def _delete_sections(
    context: Context, verdicts: Sequence[ReportVerdict], versions: Versions
) -> None:
    """Delete the temporary artifacts of published versions.

    `gc` finds the artifacts that cannot be deleted now.
    """
    for verdict in verdicts:
        if verdict.verdict == "accepted" and verdict.task_id in versions:
            with suppress(OSError):
                for digest in context.sections.pop(verdict.task_id, ()):
                    context.store.delete(digest)


# ---- Verdicts ------------------------------------------------------------------------------------


def _check_in_store(context: Context, report: Report, versions: dict[str, Manifest]) -> Report:
    """Return the report, or a failure if the store lacks its artifacts.

    Adds the summary of a manifest, signed, to `versions`.
    """
    if report.result is None or report.result.output is None:
        return report
    output = report.result.output
    try:
        if isinstance(output, PublishOutput):
            versions[report.task_id] = _read_and_sign(context, output)
        else:
            check_output(context.store, output)
    except (OSError, ValueError, ClientError) as error:
        unavailable = isinstance(error, OSError) and is_unavailable(error)
        reason = Reason.store_unavailable if unavailable else Reason.storage_error
        message = f"the result does not hold: {error}"
        return report.model_copy(update={"result": _as_failure(report.result, reason, message)})
    return report


def _read_and_sign(context: Context, output: PublishOutput) -> Manifest:
    version = read_version(context.store, output)
    key = context.settings.signing_key
    if key is not None:
        seal = seal_text(output.manifest, output.group)
        sign_version(context.store, version.dataset, version.version, seal, key)
    return version


def _as_failure(result: TaskResult, reason: Reason, message: str) -> TaskResult:
    failure = {"outcome": "failed", "reason": reason, "message": message[:MAX_MESSAGE]}
    return result.model_copy(update={**failure, "output": None})


_REPORTED_TASKS = RowQuery(
    LeasedTask,
    select(*task_columns(LeasedTask)).where(tasks.c.key.in_(bindparam("b_keys", expanding=True))),
)
_MARK_REPORTED = Statement(
    update(tasks)
    .where(tasks.c.seq.in_(bindparam("b_tasks", expanding=True)))
    .values(reported_by=bindparam("b_worker"), reported_token=tasks.c.token)
)


def _judge(
    tx: QueueTransaction, worker_id: str, reports: Sequence[Report], versions: Versions
) -> _Judgement:
    """Judge each report."""
    keys = {key for report in reports if (key := task_key(report.task_id)) is not None}
    rows: dict[str, LeasedTask] = {}
    for task in _REPORTED_TASKS.batched_rows(tx.connection, "b_keys", keys):
        rows[task_id(task.stage, task.key)] = task

    judgement = _Judgement()
    reported: list[int] = []
    for report in reports:
        row = rows.get(report.task_id)
        sender = (worker_id, report.token)
        if row is not None and (row.reported_by, row.reported_token) == sender:
            judgement.verdicts.append(ReportVerdict(task_id=report.task_id, verdict="duplicate"))
            continue
        if row is None or (row.owner, row.token) != sender:
            judgement.verdicts.append(ReportVerdict(task_id=report.task_id, verdict="stale"))
            continue
        judgement.verdicts.append(ReportVerdict(task_id=report.task_id, verdict="accepted"))
        reported.append(row.seq)
        # A second report of the same task in this batch is a duplicate.
        rows[report.task_id] = row._replace(
            owner=None, reported_by=worker_id, reported_token=report.token
        )
        if report.result is None:
            judgement.released.append(row)
        else:
            result = _check_against_task(tx, row, report.result, versions)
            judgement.ended.append(EndedTask(row, result))
    for batch in batches(reported):
        _MARK_REPORTED.run(tx.connection, {"b_tasks": batch, "b_worker": worker_id})
    return judgement


def _check_against_task(
    tx: QueueTransaction, task: LeasedTask, result: TaskResult, versions: Versions
) -> TaskResult:
    """Return the result, or a failure if it does not fit the task."""
    if result.output is not None and result.output.stage != task.stage:
        message = f"the worker answered with the output of stage {result.output.stage}"
        return _as_failure(result, Reason.internal_error, message)
    if result.outcome == "rejected" and task.stage in (Stage.pack, Stage.publish):
        message = (
            f"the worker rejected a {task.stage} task, which has no sample to reject: "
            f"{result.message}"
        )
        return _as_failure(result, Reason.internal_error, message)
    if result.output is not None and task.stage == Stage.publish:
        reserved = find_reserved(tx.connection, task.seq)
        version = versions.get(task_id(task.stage, task.key))
        if version is None or (version.dataset, version.version) != reserved:
            message = f"the manifest is not that of {reserved}"
            return _as_failure(result, Reason.storage_error, message)
    return result


# ---- Results -------------------------------------------------------------------------------------

_RESULT_COLUMNS = (
    "state",
    "reason",
    "message",
    "output",
    "digest",
    "cpu_seconds",
    "wall_seconds",
    "finished_at",
)
_STORE_RESULT = Statement(
    update(tasks)
    .where(tasks.c.seq == bindparam("b_seq"))
    .values(**{name: bindparam(f"b_{name}") for name in _RESULT_COLUMNS}, **NO_LEASE)
)


def _store_results(tx: QueueTransaction, settled: Sequence[EndedTask], versions: Versions) -> None:
    """Store results, release the tasks that depend on them, and commit versions."""
    if not settled:
        return
    rows: list[dict[str, object]] = []
    runs: list[Run] = []
    for task, result in settled:
        output = None if result.output is None else result.output.model_dump_json()
        digest = result_digest(task.key, result.outcome, result.reason, result.message, output)
        rows.append(
            {
                "b_seq": task.seq,
                "b_state": result.outcome,
                "b_reason": result.reason,
                "b_message": result.message,
                "b_output": output,
                "b_digest": digest,
                "b_cpu_seconds": result.cpu_seconds,
                "b_wall_seconds": result.wall_seconds,
                "b_finished_at": tx.now,
            }
        )
        runs.append(Run(task, result))
        if result.reason is not None:
            emit_task_event(tx, task, TaskState.rejected, result.reason, result.message)
    _STORE_RESULT.run_all(tx.connection, rows)
    seqs = [ended.task.seq for ended in settled]
    add_results(tx.connection, seqs)
    add_costs(tx.connection, runs)
    release_dependents(tx, seqs)

    for task, result in settled:
        if isinstance(result.output, RenderOutput) and result.output.preview is not None:
            _replace_preview(tx, task.seq, result.output.preview)
        elif isinstance(result.output, PublishOutput):
            _commit(tx, task.seq, versions[task_id(task.stage, task.key)], result.output)


def _replace_preview(tx: QueueTransaction, task: int, digest: str) -> None:
    """Store the preview of a render, which may have another one of an earlier run."""
    tx.connection.execute(delete(previews).where(previews.c.task == task))
    tx.connection.execute(insert(previews).values(task=task, digest=digest))


class _PublishingJob(NamedTuple):
    seq: int
    name: str | None


_PUBLISHING_JOBS = RowQuery(
    _PublishingJob,
    text(
        "SELECT jobs.seq, jobs.name FROM job_tasks JOIN jobs ON jobs.seq = job_tasks.job "
        "WHERE job_tasks.task = :b_task AND jobs.finished_at IS NULL "
        "AND jobs.state != 'cancelling' ORDER BY jobs.seq"
    ),
)


def _commit(
    tx: QueueTransaction, publish_task: int, manifest: Manifest, output: PublishOutput
) -> None:
    """Commit a version, and end the jobs that wait for it."""
    waiting = _PUBLISHING_JOBS.rows(tx.connection, {"b_task": publish_task})
    name = next((job.name for job in waiting if job.name is not None), None)
    commit_version(tx.connection, publish_task, manifest, output, name=name, now=tx.now)
    for job in waiting:
        complete_job(tx, job.seq, find_committed(tx.connection, publish_task))


# ---- Failed attempts -----------------------------------------------------------------------------


def _end_failed_attempts(
    context: Context, tx: QueueTransaction, worker: str, ended: Sequence[EndedTask]
) -> None:
    """Requeue the tasks that the worker could not help, and count the failures of the others."""
    failures: list[Failure] = []
    for task, result in ended:
        if result.reason is Reason.store_unavailable:
            context.store_watch.report(f"worker {worker} cannot use the store: {result.message}")
            requeue(tx, [task])
        elif result.reason is Reason.worker_lost:
            started = task._replace(state=TaskState.running)
            requeue_lost(tx, [started], context.settings, message=result.message)
        elif result.outcome == "failed":
            reason = result.reason or Reason.internal_error
            failures.append(Failure(task, reason, result.message))
    record_failures(tx, failures, context.settings)
