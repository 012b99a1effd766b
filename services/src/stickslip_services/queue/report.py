"""Reports: results of leased tasks. The first result from the holder of the lease is final.

A dataset version is committed by the transaction that accepts the report of its publish task.
"""

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Literal

from sqlalchemy import bindparam, delete, insert, select, update
from stickslip_schemas.base.states import Reason, Stage, TaskState
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
from stickslip_services.queue.eta import Run
from stickslip_services.queue.ids import row_digest, task_id, task_key
from stickslip_services.queue.ledger import LIVE, Ending, HeldTask, Ledger, Task, start_tasks
from stickslip_services.queue.recompute import recompute, wait_for
from stickslip_services.queue.retries import fail_tries, give_back, lose
from stickslip_services.queue.workers import find_worker, note_heard

Verdict = Literal["accepted", "duplicate", "stale"]


@dataclass(frozen=True, slots=True)
class _Ended:
    task: HeldTask
    kind: str
    cost_group: str
    result: TaskResult


_NOTE_REPORT = Prepared(
    update(tasks)
    .where(tasks.c.seq.in_(bindparam("b_tasks", expanding=True)))
    .values(reported_by=bindparam("b_worker"), reported_token=tasks.c.token)
)
_FIND = Prepared(
    select(
        *HeldTask.columns(),
        *(tasks.c[name] for name in ("kind", "cost_group", "owner", "reported_by", "reported_token")),
    ).where(tasks.c.key.in_(bindparam("b_keys", expanding=True)))
)
_SETTLED = ("state", "reason", "message", "output", "digest", "cpu_seconds", "wall_seconds", "finished_at")
_SETTLE = Prepared(
    update(tasks)
    .where(tasks.c.seq == bindparam("b_seq"))
    .values({name: bindparam(f"b_{name}") for name in _SETTLED} | {"owner": None, "expires_at": None})
)
_DEPENDENTS = Prepared(
    select(task_dependencies.c.depends_on, task_dependencies.c.task, tasks.c.key, tasks.c.stage, tasks.c.state)
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
        failed = _take_results(book, ended, versions)
        give_back(book, released)
        charged: list[tuple[HeldTask, Reason, str]] = []
        for end in failed:
            task, reason, message = end.task, end.result.reason or Reason.internal_error, end.result.message
            if reason is Reason.store_unavailable:
                context.store_watch.note(f"worker {worker.name} cannot use the store: {message}")
                give_back(book, [task])
            elif reason is Reason.worker_lost:
                lose(book, [task], context.settings, message=message)
            else:
                charged.append((task, reason, message))
        fail_tries(book, charged, context.settings)
        for end in ended:
            if end.result.damaged_inputs:
                recompute(book, end.task.seq, end.result.damaged_inputs)
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
) -> tuple[list[ReportVerdict], list[HeldTask], list[_Ended]]:
    """Judge each report; return the verdicts, the tasks that were given back, and those that have ended.

    `versions` has the summaries of manifests by publish task; they were read before the transaction.
    """
    verdicts: list[ReportVerdict] = []
    released: list[HeldTask] = []
    ended: list[_Ended] = []
    rows = _find(book, reports)
    for report in reports:
        row = rows.get(report.task_id)
        verdict: Verdict = "stale"
        if row is not None and (row.reported_by, row.reported_token) == (worker_id, report.token):
            verdict = "duplicate"
        elif row is not None and (row.owner, row.token) == (worker_id, report.token):
            verdict = "accepted"
            rows[report.task_id] = row._replace(owner=None, reported_by=worker_id, reported_token=report.token)
            task = HeldTask.of(row)
            if report.result is None:
                released.append(task)
            else:
                ended.append(_Ended(task, row.kind, row.cost_group, _checked(book, task, report.result, versions)))
        verdicts.append(ReportVerdict(task_id=report.task_id, verdict=verdict))
    accepted = [*released, *(end.task for end in ended)]
    for batch in batches(accepted):
        _NOTE_REPORT.run(book.connection, {"b_tasks": [task.seq for task in batch], "b_worker": worker_id})
    return verdicts, released, ended


def _find(book: Ledger, reports: Sequence[Report]) -> dict[str, Any]:
    keys = {key for report in reports if (key := task_key(report.task_id)) is not None}
    return {
        task_id(row.stage, row.key): row
        for batch in batches(keys)
        for row in _FIND.rows(book.connection, {"b_keys": batch})
    }


def _checked(book: Ledger, task: HeldTask, result: TaskResult, versions: dict[str, Manifest]) -> TaskResult:
    """Return the result, or a failure where it does not fit the task."""
    wrong: str | None = None
    reason = Reason.internal_error
    if result.output is not None and result.output.stage != task.stage:
        wrong = f"the worker answered with the output of stage {result.output.stage}"
    elif result.outcome == "rejected" and task.stage in (Stage.pack, Stage.publish):
        wrong = f"the worker rejected a {task.stage} task, which has no sample to reject: {result.message}"
    elif result.output is not None and task.stage is Stage.publish:
        reason = Reason.storage_error
        reserved = find_reserved(book.connection, task.seq)
        version = versions.get(task.name)
        if version is None or (version.dataset, version.version) != reserved:
            wrong = f"the manifest is not that of {reserved}"
    if wrong is None:
        return result
    return _failed(result, reason, wrong)


def _take_results(book: Ledger, ended: Sequence[_Ended], versions: dict[str, Manifest]) -> list[_Ended]:
    """Store results; return the failures."""
    # Who reports a result has started the task, whether or not a heartbeat said so in between.
    start_tasks(book, [end.task for end in ended if end.task.state is TaskState.leased])
    ended = [replace(end, task=replace(end.task, state=TaskState.running)) for end in ended]
    settled = [end for end in ended if end.result.outcome != "failed"]
    _settle(book, settled)
    for end in settled:
        output = end.result.output
        if isinstance(output, RenderOutput) and output.preview is not None:
            book.connection.execute(delete(previews).where(previews.c.task == end.task.seq))  # of an earlier run
            book.connection.execute(insert(previews).values(task=end.task.seq, digest=output.preview))
        elif isinstance(output, PublishOutput):
            _commit(book, end.task.seq, versions[end.task.name], output)
    return [end for end in ended if end.result.outcome == "failed"]


def _commit(book: Ledger, publish_task: int, manifest: Manifest, output: PublishOutput) -> None:
    """Commit a version, and end the jobs that wait for it."""
    connection = book.connection
    holders = [holder.job for holder in book.holders([publish_task]).get(publish_task, ())]
    waiting = connection.execute(
        select(jobs.c.seq, jobs.c.name).where(jobs.c.seq.in_(holders), jobs.c.state.in_(LIVE)).order_by(jobs.c.seq)
    ).all()
    name = next((row.name for row in waiting if row.name is not None), None)
    commit_version(connection, publish_task, manifest, output, name=name, now=book.now)
    for row in waiting:
        book.end_job(row.seq, Ending.published(find_committed(connection, publish_task)))


def _settle(book: Ledger, settled: Sequence[_Ended]) -> None:
    """Store results, and release the tasks that depend on them."""
    _SETTLE.run_all(
        book.connection,
        [
            _settled(book, end.task.seq, end.task.key, result.outcome, result.reason, result.message, output)
            | {"b_cpu_seconds": result.cpu_seconds, "b_wall_seconds": result.wall_seconds}
            for end in settled
            for result in [end.result]
            for output in [None if result.output is None else result.output.model_dump_json()]
        ],
    )
    rejected: dict[int, tuple[Reason, str]] = {}
    for end in settled:
        task, result = end.task, end.result
        state = TaskState(result.outcome)
        book.moved(task, state)
        # Rejections often come early, so their durations are not representative.
        call_seconds = None if state is TaskState.rejected else result.call_seconds
        cost = (result.cpu_seconds, result.wall_seconds, call_seconds)
        book.ran(Run(task.seq, task.stage, end.kind, end.cost_group, *cost))
        if result.reason is not None:
            rejected[task.seq] = (result.reason, result.message)
            book.emit(task, state, result.reason, result.message)
    _release_dependents(book, [end.task.seq for end in settled], rejected)


def _settled(
    book: Ledger, seq: int, key: bytes, state: str, reason: Reason | None, message: str, output: str | None
) -> dict[str, Any]:
    """Return the parameters of `_SETTLE` for a task whose run took no time."""
    made = {"b_state": state, "b_reason": reason, "b_message": message, "b_output": output}
    digest = row_digest(key, *made.values())
    free = {"b_cpu_seconds": None, "b_wall_seconds": None}
    return {"b_seq": seq, **made, "b_digest": digest, "b_finished_at": book.now} | free


def _release_dependents(book: Ledger, settled: Sequence[int], rejected: dict[int, tuple[Reason, str]]) -> None:
    """Decrement `waiting_on` of dependents; a rejected simulation rejects its renders, which settles them in turn."""
    edges = [edge for batch in batches(settled) for edge in _DEPENDENTS.tuples(book.connection, {"b_tasks": batch})]
    if not edges:
        return
    waits = Counter(task for _, task, _, _, _ in edges)
    wait_for(book, {task: -count for task, count in waits.items()})
    doomed = [
        (Task(task, Stage.render, TaskState(state)), key, rejected[dependency])
        for dependency, task, key, stage, state in edges
        if stage == Stage.render and dependency in rejected and not TaskState(state).is_settled
    ]
    settled_too = [_settled(book, task.seq, key, TaskState.rejected, *why, None) for task, key, why in doomed]
    _SETTLE.run_all(book.connection, settled_too)
    for task, _, _ in doomed:
        book.moved(task, TaskState.rejected)
    _release_dependents(book, [task.seq for task, _, _ in doomed], {})
