"""Dependents of tasks: they wait for results, and become ready when all results are there.

If a simulation is rejected, its renders are rejected too. Their rejections are results in turn.
"""

from collections.abc import Collection
from typing import NamedTuple

from sqlalchemy import BindParameter, bindparam, text

from stickslip_services.database.statements import RowQuery, Statement, batches
from stickslip_services.queue.integrity import result_digest
from stickslip_services.queue.ready import add_ready, remove_ready
from stickslip_services.queue.totals import add_results
from stickslip_services.queue.transaction import QueueTransaction


class _Dependent(NamedTuple):
    seq: int
    waiting_on: int


_TASKS: BindParameter[int] = bindparam("b_tasks", expanding=True)
_CHANGE = (
    "UPDATE tasks SET waiting_on = waiting_on {sign} (SELECT count(*) FROM task_dependencies "
    "WHERE task_dependencies.task = tasks.seq AND task_dependencies.depends_on IN :b_tasks) "
    "WHERE seq IN (SELECT task FROM task_dependencies WHERE depends_on IN :b_tasks) "
    "RETURNING seq, waiting_on"
)
_WAIT_FOR_LESS = RowQuery(_Dependent, text(_CHANGE.format(sign="-")).bindparams(_TASKS))
_WAIT_FOR_MORE = RowQuery(_Dependent, text(_CHANGE.format(sign="+")).bindparams(_TASKS))


class _RenderToReject(NamedTuple):
    """A render, with the rejection of its simulation."""

    seq: int
    key: bytes
    reason: str | None
    message: str


_RENDERS_TO_REJECT = RowQuery(
    _RenderToReject,
    text(
        "SELECT render.seq, render.key, simulation.reason, simulation.message "
        "FROM tasks AS simulation CROSS JOIN task_dependencies CROSS JOIN tasks AS render "
        "WHERE simulation.seq IN :b_tasks AND simulation.state = 'rejected' "
        "AND task_dependencies.depends_on = simulation.seq "
        "AND render.seq = task_dependencies.task AND render.stage = 'render' "
        "AND render.state NOT IN ('succeeded', 'rejected')"
    ).bindparams(_TASKS),
)
_REJECT = Statement(
    "UPDATE tasks SET state = 'rejected', reason = :b_reason, message = :b_message, output = NULL, "
    "digest = :b_digest, cpu_seconds = NULL, wall_seconds = NULL, retry_at = NULL, "
    "finished_at = :b_now WHERE seq = :b_seq"
)


def release_dependents(tx: QueueTransaction, tasks: Collection[int]) -> None:
    """Count down the missing results of the dependents of tasks that have just got results."""
    ready: list[int] = []
    # The database counts down and tells in one statement which tasks have nothing left to wait for.
    for batch in batches(tasks):
        for row in _WAIT_FOR_LESS.rows(tx.connection, {"b_tasks": batch}):
            if row.waiting_on == 0:
                ready.append(row.seq)
    # Renders of rejected simulations wait for nothing either. Reject them before the other tasks
    # become ready, so that no worker gets one of them.
    if ready:
        reject_renders(tx, tasks)
        add_ready(tx.connection, ready)


def reject_renders(tx: QueueTransaction, simulations: Collection[int]) -> None:
    """Reject the renders of the rejected ones among some simulations."""
    renders: list[_RenderToReject] = []
    for batch in batches(simulations):
        renders += _RENDERS_TO_REJECT.rows(tx.connection, {"b_tasks": batch})
    if not renders:
        return
    rows: list[dict[str, object]] = []
    for render in renders:
        digest = result_digest(render.key, "rejected", render.reason, render.message, None)
        row = {"b_seq": render.seq, "b_reason": render.reason, "b_message": render.message}
        rows.append({**row, "b_digest": digest, "b_now": tx.now})
    _REJECT.run_all(tx.connection, rows)
    rejected = [render.seq for render in renders]
    # A rejection is a result: it leaves the queue, counts in the totals and releases the pack
    # tasks.
    remove_ready(tx.connection, rejected)
    add_results(tx.connection, rejected)
    release_dependents(tx, rejected)


def hold_dependents(tx: QueueTransaction, tasks: Collection[int]) -> None:
    """Let the dependents of tasks whose results are discarded wait for them again."""
    waiting: list[int] = []
    for batch in batches(tasks):
        for row in _WAIT_FOR_MORE.rows(tx.connection, {"b_tasks": batch}):
            waiting.append(row.seq)
    remove_ready(tx.connection, waiting)
