"""Artifacts that are damaged or lost in the store: the tasks that produced them run again.

A worker reports inputs that it finds damaged. The coordinator looks for their producers among the
dependencies of the worker's task. The producers return to `pending`, and their dependents wait for
them. If the inputs of a producer are damaged too, its worker reports that in turn.
"""

import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

from sqlalchemy import BindParameter, bindparam, text, update
from stickslip_schemas.base import Sha256, TaskState

from stickslip_services.database.statements import RowQuery, ValueQuery, batches, insert_rows
from stickslip_services.database.tables import task_dependencies, tasks
from stickslip_services.queue.dependents import hold_dependents
from stickslip_services.queue.ready import add_ready, remove_ready
from stickslip_services.queue.rows import FINISHED, HAS_RESULT
from stickslip_services.queue.totals import remove_results
from stickslip_services.queue.transaction import QueueTransaction

DIGEST = re.compile(r"[0-9a-f]{64}")

RESET_ATTEMPTS = {"reason": None, "message": "", "tries": 0, "losses": 0}
"""Values of a task that has all its tries."""


class Producer(NamedTuple):
    """A task that other tasks depend on."""

    seq: int
    state: str
    output: str | None


_TASKS: BindParameter[int] = bindparam("b_tasks", expanding=True)
_DEPENDENCIES = RowQuery(
    Producer,
    text(
        "SELECT DISTINCT tasks.seq, tasks.state, tasks.output FROM task_dependencies "
        "JOIN tasks ON tasks.seq = task_dependencies.depends_on "
        "WHERE task_dependencies.task IN :b_tasks"
    ).bindparams(_TASKS),
)
_DEPENDS_ON: ValueQuery[int] = ValueQuery(
    "SELECT depends_on FROM task_dependencies WHERE task = :b_task"
)
_PRODUCERS = RowQuery(
    Producer,
    text("SELECT seq, state, output FROM tasks WHERE seq IN :b_tasks").bindparams(_TASKS),
)


def rerun_producers(tx: QueueTransaction, consumer: int, digests: Collection[Sha256]) -> None:
    """Reset the tasks that produced `digests`, and let the task `consumer` wait for them."""
    producers = _find_producers(tx, consumer, set(digests))
    add_dependencies(tx, consumer, [producer.seq for producer in producers])
    reset_results(tx, producers)


def add_dependencies(tx: QueueTransaction, consumer: int, producers: Sequence[int]) -> None:
    """Let a task depend on other tasks, too."""
    known = set(_DEPENDS_ON.values(tx.connection, {"b_task": consumer}))
    missing = [seq for seq in producers if seq not in known]
    edges = [(consumer, seq) for seq in missing]
    insert_rows(tx.connection, task_dependencies, ("task", "depends_on"), edges)
    more = 0
    for producer in _PRODUCERS.batched_rows(tx.connection, "b_tasks", missing):
        more += producer.state not in HAS_RESULT
    if more:
        wait = update(tasks).where(tasks.c.seq == consumer)
        tx.connection.execute(wait.values(waiting_on=tasks.c.waiting_on + more))
        remove_ready(tx.connection, [consumer])


def reset_tasks(tx: QueueTransaction, seqs: Sequence[int]) -> None:
    """Let finished tasks run again, with all their tries."""
    reset_results(tx, _PRODUCERS.batched_rows(tx.connection, "b_tasks", seqs))


def reset_results(tx: QueueTransaction, producers: Sequence[Producer]) -> None:
    """Let tasks whose states are known run again, with all their tries.

    Their outputs stay until the next result.
    """
    finished = [producer.seq for producer in producers if producer.state in FINISHED]
    settled = [producer.seq for producer in producers if producer.state in HAS_RESULT]
    remove_results(tx.connection, finished)
    hold_dependents(tx, settled)
    for batch in batches(finished):
        reset = update(tasks).where(tasks.c.seq.in_(batch))
        pending = {"state": TaskState.pending, "finished_at": None}
        costs = {"cpu_seconds": None, "wall_seconds": None}
        tx.connection.execute(reset.values(**pending, **costs, **RESET_ATTEMPTS))
    add_ready(tx.connection, finished)


def _find_producers(tx: QueueTransaction, consumer: int, digests: set[Sha256]) -> list[Producer]:
    """Return the tasks that produced `digests`, searched breadth-first below `consumer`."""
    producers: list[Producer] = []
    level = {consumer}
    visited = {consumer}
    while level and digests:
        below: set[int] = set()
        for row in _DEPENDENCIES.batched_rows(tx.connection, "b_tasks", level):
            produced = digests.intersection(DIGEST.findall(row.output or ""))
            if produced and row.seq not in visited:
                producers.append(row)
                digests = digests - produced
            below.add(row.seq)
        level = below - visited
        visited |= below
    return producers
