"""Reports: results of leased tasks. The first result from the holder of the lease is final.

A dataset version is committed by the transaction that accepts the report of its publish task.
"""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from sqlalchemy import bindparam, delete, insert, select, update
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
from stickslip_services.database.database import batches
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import jobs, previews, task_dependencies, tasks
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import row_digest, task_id, task_key
from stickslip_services.queue.ledger import LIVE, SETTLED, Ledger
from stickslip_services.queue.recompute import recompute, wait_for
from stickslip_services.queue.retries import HELD_TASK, fail_tries, give_back, lose
from stickslip_services.queue.workers import find_worker, note_heard

Ended = tuple[Any, TaskResult]
"""A task, a row of `_FIND`, and its result."""

_NOTE_REPORT = Prepared(
    update(tasks)
    .where(tasks.c.seq.in_(bindparam("b_tasks", expanding=True)))
    .values(reported_by=bindparam("b_worker"), reported_token=tasks.c.token)
)
_FIND = Prepared(
    select(
        *HELD_TASK, *(tasks.c[name] for name in ("kind", "cost_group", "owner", "reported_by", "reported_token"))
    ).where(tasks.c.key.in_(bindparam("b_keys", expanding=True)))
)
_WRITTEN = ("state", "reason", "message", "output", "digest", "cpu_seconds", "wall_seconds", "finished_at")
_SETTLE = Prepared(
    update(tasks)
    .where(tasks.c.seq == bindparam("b_seq"))
    .values({name: bindparam(f"b_{name}") for name in _WRITTEN} | {"owner": None, "expires_at": None})
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
    with context.ledger() as book:
        worker = find_worker(book.connection, batch.worker_id)
        note_heard(book.connection, [worker.id], book.now)
        verdicts, released, ended = _judged(book, worker.id, reports, versions)
        give_back(book, released)
        # Who reports a result has started the task, whether or not a heartbeat said so in between.
        book.start([task for task, _ in ended if task.state == TaskState.leased])
        ended = [(task._replace(state=TaskState.running), result) for task, result in ended]
        _take_results(book, [(task, result) for task, result in ended if result.outcome != "failed"], versions)
        charged: list[tuple[Any, Reason, str]] = []
        for task, result in ended:
            if result.reason is Reason.store_unavailable:
                context.store_watch.note(f"worker {worker.name} cannot use the store: {result.message}")
                give_back(book, [task])
            elif result.reason is Reason.worker_lost:
                lose(book, [task], context.settings, message=result.message)
            elif result.outcome == "failed":
                charged.append((task, result.reason or Reason.internal_error, result.message))
        fail_tries(book, charged, context.settings)
        for task, result in ended:
            if result.damaged_inputs:
                recompute(book, task.seq, result.damaged_inputs)
    for verdict in verdicts:
        if verdict.verdict == "accepted" and verdict.task_id in versions:
            with suppress(OSError):
                for digest in context.sections.pop(verdict.task_id, ()):
                    context.store.delete(digest)
    return ReportAnswer(verdicts=tuple(verdicts))


def _checked_in_store(context: Context, report: Report, versions: dict[str, Manifest]) -> Report:
    """Return the report, or a failure where the store lacks its artifacts; add the summary of a manifest, signed."""
    if report.result is None or report.result.output is None:
        return report
    output = report.result.output
    try:
        if isinstance(output, PublishOutput):
            version = read_version(context.store, output)
            if context.settings.signing_key is not None:
                seal = seal_text(output.manifest, output.group)
                sign_version(context.store, version.dataset, version.version, seal, context.settings.signing_key)
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
    book: Ledger, worker_id: str, reports: Sequence[Report], versions: dict[str, Manifest]
) -> tuple[list[ReportVerdict], list[Any], list[Ended]]:
    """Judge each report; return the verdicts, the tasks that were given back, and those that have ended.

    `versions` has the summaries of manifests by publish task; they were read before the transaction.
    """
    verdicts: list[ReportVerdict] = []
    released: list[Any] = []
    ended: list[Ended] = []
    keys = {key for report in reports if (key := task_key(report.task_id)) is not None}
    found = (row for batch in batches(keys) for row in _FIND.rows(book.connection, {"b_keys": batch}))
    rows = {task_id(row.stage, row.key): row for row in found}
    for report in reports:
        row, mine = rows.get(report.task_id), (worker_id, report.token)
        if row is not None and (row.reported_by, row.reported_token) == mine:
            verdicts.append(ReportVerdict(task_id=report.task_id, verdict="duplicate"))
        elif row is None or (row.owner, row.token) != mine:
            verdicts.append(ReportVerdict(task_id=report.task_id, verdict="stale"))
        else:
            verdicts.append(ReportVerdict(task_id=report.task_id, verdict="accepted"))
            rows[report.task_id] = row._replace(owner=None, reported_by=worker_id, reported_token=report.token)
            if report.result is None:
                released.append(row)
            else:
                ended.append((row, _checked(book, row, report.result, versions)))
    for batch in batches([*released, *(task for task, _ in ended)]):
        _NOTE_REPORT.run(book.connection, {"b_tasks": [task.seq for task in batch], "b_worker": worker_id})
    return verdicts, released, ended


def _checked(book: Ledger, task: Any, result: TaskResult, versions: dict[str, Manifest]) -> TaskResult:
    """Return the result, or a failure where it does not fit the task."""
    if result.output is not None and result.output.stage != task.stage:
        wrong = f"the worker answered with the output of stage {result.output.stage}"
        return _failed(result, Reason.internal_error, wrong)
    if result.outcome == "rejected" and task.stage in (Stage.pack, Stage.publish):
        wrong = f"the worker rejected a {task.stage} task, which has no sample to reject: {result.message}"
        return _failed(result, Reason.internal_error, wrong)
    if result.output is not None and task.stage == Stage.publish:
        reserved, version = find_reserved(book.connection, task.seq), versions.get(task_id(task.stage, task.key))
        if version is None or (version.dataset, version.version) != reserved:
            return _failed(result, Reason.storage_error, f"the manifest is not that of {reserved}")
    return result


def _take_results(book: Ledger, settled: Sequence[Ended], versions: dict[str, Manifest]) -> None:
    """Store results, release the tasks that depend on them, and commit versions."""
    written = []
    rejected: dict[int, tuple[Reason, str]] = {}
    for task, result in settled:
        output = None if result.output is None else result.output.model_dump_json()
        costs = {"b_cpu_seconds": result.cpu_seconds, "b_wall_seconds": result.wall_seconds}
        written.append(_written(book, task, result.outcome, result.reason, result.message, output) | costs)
        book.moved([task], TaskState(result.outcome))
        book.ran(task, result)
        if result.reason is not None:
            rejected[task.seq] = (result.reason, result.message)
            book.tell(task, TaskState.rejected, *rejected[task.seq])
    _SETTLE.run_all(book.connection, written)
    _release_dependents(book, [task.seq for task, _ in settled], rejected)
    for task, result in settled:
        if isinstance(result.output, RenderOutput) and result.output.preview is not None:
            book.connection.execute(delete(previews).where(previews.c.task == task.seq))  # of an earlier run
            book.connection.execute(insert(previews).values(task=task.seq, digest=result.output.preview))
        elif isinstance(result.output, PublishOutput):
            _commit(book, task.seq, versions[task_id(task.stage, task.key)], result.output)


def _commit(book: Ledger, publish_task: int, manifest: Manifest, output: PublishOutput) -> None:
    """Commit a version, and end the jobs that wait for it."""
    connection = book.connection
    of_task = (jobs.c.seq.in_(book.jobs_of(publish_task)), jobs.c.state.in_(LIVE))
    waiting = connection.execute(select(jobs.c.seq, jobs.c.name).where(*of_task).order_by(jobs.c.seq)).all()
    name = next((row.name for row in waiting if row.name is not None), None)
    commit_version(connection, publish_task, manifest, output, name=name, now=book.now)
    for row in waiting:
        book.publish(row.seq, find_committed(connection, publish_task))


def _written(
    book: Ledger, task: Any, state: str, reason: Reason | None, message: str, output: str | None
) -> dict[str, Any]:
    """Return the parameters of `_SETTLE` for a task whose run took no time."""
    made = {"b_state": state, "b_reason": reason, "b_message": message, "b_output": output}
    free = {"b_cpu_seconds": None, "b_wall_seconds": None, "b_finished_at": book.now}
    return {"b_seq": task.seq, **made, "b_digest": row_digest(task.key, *made.values()), **free}


def _release_dependents(book: Ledger, settled: Sequence[int], rejected: dict[int, tuple[Reason, str]]) -> None:
    """Decrement `waiting_on` of dependents; a rejected simulation rejects its renders, which settles them in turn."""
    edges = [edge for batch in batches(settled) for edge in _DEPENDENTS.rows(book.connection, {"b_tasks": batch})]
    if not edges:
        return
    wait_for(book, {seq: -count for seq, count in Counter(edge.seq for edge in edges).items()})
    doomed = [
        edge
        for edge in edges
        if edge.stage == Stage.render and edge.depends_on in rejected and edge.state not in SETTLED
    ]
    why = [_written(book, edge, TaskState.rejected, *rejected[edge.depends_on], None) for edge in doomed]
    _SETTLE.run_all(book.connection, why)
    book.moved(doomed, TaskState.rejected)
    _release_dependents(book, [edge.seq for edge in doomed], {})
