"""Recomputing results that were damaged or lost in the store.

A task whose inputs are damaged reports them. The tasks that made them, found among its dependencies, go back to
`pending`, and their dependents wait for them. If the inputs of those tasks are damaged too, they report that in turn.

A job whose dataset existed before its submission ends when the files of the dataset have been checked; damaged ones
are recomputed.
"""

import logging
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sqlalchemy import bindparam, select, update
from stickslip_schemas.base.keys import Sha256
from stickslip_schemas.base.states import JobState, Stage, TaskState

from stickslip_services.catalog.versions import damaged_files, find_committed
from stickslip_services.database.database import batches, insert_rows
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import dataset_versions, jobs, task_dependencies, tasks
from stickslip_services.queue.context import Context
from stickslip_services.queue.events import set_job_state
from stickslip_services.queue.ledger import LIVE, Ending, Ledger, Task, live_jobs, reset_tasks

logger = logging.getLogger(__name__)

CHECKED_AT_ONCE = 64 * 2**20
"""Largest dataset that is checked within a request, and not in the background [bytes]."""

_DIGEST = re.compile(r"[0-9a-f]{64}")


def recompute(book: Ledger, consumer: int, digests: Collection[Sha256]) -> int:
    """Reset the tasks that made `digests`, and let `consumer` wait for them; return their number."""
    return remake(book, consumer, _find_makers(book, consumer, set(digests)))


def remake(book: Ledger, consumer: int, makers: Sequence[Task]) -> int:
    """Reset tasks, and let `consumer` wait for them; return their number."""
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


# Live jobs whose dataset existed before their submission, and has not been checked yet.
_MADE_JOBS = Prepared(
    select(
        jobs.c.seq,
        jobs.c.publish_task,
        dataset_versions.c.manifest,
        dataset_versions.c.group_digest,
        dataset_versions.c.bytes,
    )
    .join(tasks, tasks.c.seq == jobs.c.publish_task)
    .join(dataset_versions, dataset_versions.c.publish_task == jobs.c.publish_task)
    .where(jobs.c.state.in_(LIVE), tasks.c.state == TaskState.succeeded)
    .order_by(jobs.c.seq)
)


def check_made_datasets(context: Context, *, at_most: int | None = None) -> None:
    """Check datasets that existed before the submission of a live job, and end the jobs or recompute what is damaged.

    All files are read. Datasets of more than `at_most` bytes are left for a call without it.
    """
    with context.database.read() as connection:
        found = _MADE_JOBS.rows(connection)
    for made in found:
        if at_most is None or made.bytes <= at_most:
            try:
                damaged = damaged_files(context.store, made.manifest, made.group_digest)
            except OSError as error:  # out of reach: the next sweep tries again
                logger.warning("an existing dataset cannot be checked now: %s", error)
                continue
            with context.ledger() as book:
                end_made(book, made, damaged)


def end_made(book: Ledger, made: Any, damaged: Mapping[str, Sha256] | None) -> None:
    """End a job (a row of `_MADE_JOBS`) whose dataset is intact; otherwise reset the tasks that made the damaged files.

    `damaged` has the paths and digests of the damaged files; None if the manifest itself cannot be trusted.
    """
    if made not in _MADE_JOBS.rows(book.connection):
        return  # cancelled, or ended by another check
    if damaged is not None and not damaged:
        own = dataset_versions.c.publish_task == made.publish_task
        book.connection.execute(update(dataset_versions).where(own).values(scrubbed_at=book.now, damaged=0))
        ending = Ending.published(find_committed(book.connection, made.publish_task))
        book.end_job(made.seq, replace(ending, message=ending.message or "every result was cached"))
        return
    what = "its manifest was" if damaged is None else f"{len(damaged)} of its files were"
    message = f"the dataset was made before, but {what} damaged or lost in the store; missing files are recomputed"
    set_job_state(book, made.seq, JobState.queued, message=message)
    reopen(book, [Task(made.publish_task, Stage.publish, TaskState.succeeded)])
    recompute(book, made.publish_task, damaged.values() if damaged else ())


def reopen(book: Ledger, makers: Iterable[Task]) -> None:
    """Reset ended tasks that a live job needs. Their outputs stay until there are new ones."""
    ended = [maker for maker in makers if maker.state.is_over]
    job_of = live_jobs(book.connection, [maker.seq for maker in ended])
    ended = [maker for maker in ended if maker.seq in job_of]
    settled = [maker.seq for maker in ended if maker.state.is_settled]
    dependents: Counter[int] = Counter()
    for batch in batches(settled):
        edges = select(task_dependencies.c.task).where(task_dependencies.c.depends_on.in_(batch))
        dependents.update(book.connection.scalars(edges))
    _wait_for(book, dependents)
    reset_tasks(book, ended, job_of)


def _find_makers(book: Ledger, consumer: int, digests: set[Sha256]) -> list[Task]:
    """Return the tasks that made `digests`, searched breadth-first among the dependencies of `consumer`."""
    makers: list[Task] = []
    level, seen = {consumer}, {consumer}
    while level and digests:
        below: set[int] = set()
        for batch in batches(level):
            rows = book.connection.execute(
                select(*Task.columns(), tasks.c.output)
                .join(task_dependencies, task_dependencies.c.depends_on == tasks.c.seq)
                .where(task_dependencies.c.task.in_(batch))
                .distinct()
            )
            for row in rows:
                made = digests.intersection(_DIGEST.findall(row.output or ""))
                if row.seq not in seen and made:
                    makers.append(Task.of(row))
                    digests = digests - made
                below.add(row.seq)
        level = below - seen
        seen |= below
    return makers


def _wait_for(book: Ledger, more: Counter[int]) -> None:
    """Increase the number of tasks that each task waits for."""
    rows = [{"b_seq": task, "b_more": count} for task, count in more.items() if count]
    if rows:
        book.connection.execute(
            update(tasks)
            .where(tasks.c.seq == bindparam("b_seq"))
            .values(waiting_on=tasks.c.waiting_on + bindparam("b_more")),
            rows,
        )
