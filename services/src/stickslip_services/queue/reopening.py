"""Tasks whose results were lost after all: an artifact that rotted in the store, or is gone, is made again.

Whoever needs such an artifact reports it. The task that made it, found among those that the reporter builds on, goes
back to `pending`, and all that depend on it wait for one task more. What that task needs itself it reports in turn.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from sqlalchemy import bindparam, select, update
from stickslip_schemas.keys import Sha256
from stickslip_schemas.states import Stage, TaskState

from stickslip_services.database.database import batches, insert_rows
from stickslip_services.database.tables import task_dependencies, tasks
from stickslip_services.queue.ledger import Ledger, live_jobs

_DIGEST = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class _Maker:
    seq: int
    stage: Stage
    state: TaskState


def make_again(book: Ledger, consumer: int, digests: Collection[Sha256]) -> int:
    """Let the tasks that made `digests` run again, and `consumer`, which waits, wait for them; return how many."""
    makers = _find_makers(book, consumer, set(digests))
    if not makers:
        return 0
    known = set(
        book.connection.scalars(select(task_dependencies.c.depends_on).where(task_dependencies.c.task == consumer))
    )
    new = [maker for maker in makers if maker.seq not in known]
    insert_rows(book.connection, task_dependencies, ("task", "depends_on"), ((consumer, maker.seq) for maker in new))
    _wait_for(book, Counter({consumer: sum(not maker.state.is_settled for maker in new)}))
    reopen(book, makers)
    return len(makers)


def reopen_task(book: Ledger, task: int) -> None:
    """Let one task that has a result run again."""
    row = book.connection.execute(select(tasks.c.stage, tasks.c.state).where(tasks.c.seq == task)).one()
    reopen(book, [_Maker(task, Stage(row.stage), TaskState(row.state))])


def reopen(book: Ledger, makers: Iterable[_Maker]) -> None:
    """Let tasks that have ended, and that a live job needs, run again. Their outputs stay until there are new ones."""
    ended = [maker for maker in makers if maker.state in (TaskState.succeeded, TaskState.failed, TaskState.cancelled)]
    job_of = live_jobs(book.connection, [maker.seq for maker in ended])
    ended = [maker for maker in ended if maker.seq in job_of]
    settled = [maker.seq for maker in ended if maker.state.is_settled]
    dependents: Counter[int] = Counter()
    for batch in batches(settled):
        edges = select(task_dependencies.c.task).where(task_dependencies.c.depends_on.in_(batch))
        dependents.update(book.connection.scalars(edges))
    _wait_for(book, dependents)
    for maker in ended:
        book.connection.execute(
            update(tasks)
            .where(tasks.c.seq == maker.seq)
            .values(
                state=TaskState.pending,
                reason=None,
                message="",
                job=job_of[maker.seq],
                tries=0,
                retry_at=None,
                finished_at=None,
            )
        )
        book.moved(maker.seq, maker.stage, maker.state, TaskState.pending)


def _find_makers(book: Ledger, consumer: int, digests: set[Sha256]) -> list[_Maker]:
    """Look for the tasks that made `digests`, first among those that `consumer` needs, then among what those need."""
    makers: list[_Maker] = []
    level, seen = {consumer}, {consumer}
    while level and digests:
        below: set[int] = set()
        for batch in batches(level):
            rows = book.connection.execute(
                select(tasks.c.seq, tasks.c.stage, tasks.c.state, tasks.c.output)
                .join(task_dependencies, task_dependencies.c.depends_on == tasks.c.seq)
                .where(task_dependencies.c.task.in_(batch))
                .distinct()
            )
            for seq, stage, state, output in rows:
                made = digests.intersection(_DIGEST.findall(output or ""))
                if seq not in seen and made:
                    makers.append(_Maker(seq, Stage(stage), TaskState(state)))
                    digests = digests - made
                below.add(seq)
        level = below - seen
        seen |= below
    return makers


def _wait_for(book: Ledger, more: Counter[int]) -> None:
    """Let tasks wait for so many more others."""
    rows = [{"b_seq": task, "b_more": count} for task, count in more.items() if count]
    if rows:
        book.connection.execute(
            update(tasks)
            .where(tasks.c.seq == bindparam("b_seq"))
            .values(waiting_on=tasks.c.waiting_on + bindparam("b_more")),
            rows,
        )
