"""Tasks whose results were lost after all: an artifact that rotted in the store, or is gone, is made again.

Whoever needs such an artifact reports it. The task that made it, found among those that the reporter builds on, goes
back to `pending`, and all that depend on it wait for one task more. What that task needs itself it reports in turn.

A job whose dataset was made before it came ends when the dataset has been checked, and what is damaged is made again.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

from sqlalchemy import Connection, bindparam, select, update
from stickslip_schemas.base.keys import Sha256
from stickslip_schemas.base.states import JobState, Stage, TaskState

from stickslip_services.catalog.versions import find_committed
from stickslip_services.database.database import batches, insert_rows
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import dataset_versions, jobs, task_dependencies, tasks
from stickslip_services.queue.events import set_job_state
from stickslip_services.queue.ledger import LIVE, Ending, Ledger, live_jobs

_DIGEST = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True, slots=True)
class MadeJob:
    """A live job whose dataset was made before it came."""

    job: int
    publish_task: int
    manifest: Sha256
    group: Sha256 | None
    bytes: int


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


def made_jobs(connection: Connection) -> list[MadeJob]:
    """Return the live jobs whose dataset was made before they came; its files have to be checked."""
    return [MadeJob(*row) for row in _MADE_JOBS.tuples(connection)]


def end_made(book: Ledger, made: MadeJob, damaged: frozenset[Sha256] | None) -> None:
    """End a job whose dataset is there and whole, or else let the tasks that made it run again.

    `damaged` are the artifacts that are not whole; None where the manifest itself cannot be trusted.
    """
    if made not in made_jobs(book.connection):
        return  # cancelled, or ended by another check
    if damaged is not None and not damaged:
        version = find_committed(book.connection, made.publish_task)
        ending = Ending.published(
            version.reference, sample_count=version.sample_count, rejected_count=version.rejected_count
        )
        book.end_job(made.job, replace(ending, message=ending.message or "every result was cached"))
        return
    what = "its manifest was" if damaged is None else f"{len(damaged)} of its files were"
    message = f"the dataset was made before, but {what} damaged or lost in the store; what is missing is made again"
    set_job_state(book.connection, made.job, JobState.queued, book.now, message=message)
    reopen_task(book, made.publish_task)
    make_again(book, made.publish_task, damaged or frozenset())


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
                losses=0,
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
