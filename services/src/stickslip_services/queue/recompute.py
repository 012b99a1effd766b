"""Finding rows that are damaged, and recomputing results that were damaged or lost in the database
or the store.

A bit that flips in a row shows. The content key of a task is the digest of what it is; what it
made, the rows of samples, and the terms of a job have digests beside them. Where other rows than
results are damaged, the job fails; its spec, submitted again, writes them anew.

A task whose inputs are damaged reports them. The tasks that made them, found among its
dependencies, go back to `pending`, and their dependents wait for them. If the inputs of those tasks
are damaged too, they report that in turn.

A job whose dataset existed before its submission ends when the files of the dataset have been
checked; damaged ones are recomputed.
"""

import logging
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, and_, bindparam, or_, select, update
from stickslip_schemas.base import JobState, Reason, Sha256, Stage, TaskState
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.catalog.versions import damaged_files, find_committed
from stickslip_services.database.database import Prepared, insert_rows, rows_with
from stickslip_services.database.tables import dataset_versions, jobs, task_dependencies, tasks
from stickslip_services.errors import DamagedRowsError
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import SAMPLE_COLUMNS, row_digest
from stickslip_services.queue.plan import Terms
from stickslip_services.queue.rows import Task
from stickslip_services.queue.transaction import (
    FINISHED,
    LIVE,
    RESET_ATTEMPTS,
    SETTLED,
    TASK_COLUMNS,
    QueueTransaction,
    assign,
    live_jobs,
)

logger = logging.getLogger(__name__)

CHECKED_AT_ONCE = 64 * 2**20
"""Largest dataset that is checked within a request, and not in the background [bytes]."""

DIGEST = re.compile(r"[0-9a-f]{64}")


def recompute(tx: QueueTransaction, consumer: int, digests: Collection[Sha256]) -> None:
    """Reset the tasks that made `digests`, and let `consumer` wait for them."""
    rerun_producers(tx, consumer, _find_makers(tx, consumer, set(digests)))


def rerun_producers(tx: QueueTransaction, consumer: int, makers: Sequence[Any]) -> None:
    """Reset tasks, and let `consumer` wait for them."""
    known = set(
        tx.connection.scalars(
            select(task_dependencies.c.depends_on).where(task_dependencies.c.task == consumer)
        )
    )
    new = [maker for maker in makers if maker.seq not in known]
    insert_rows(
        tx.connection,
        task_dependencies,
        ("task", "depends_on"),
        ((consumer, maker.seq) for maker in new),
    )
    add_dependencies(tx, {consumer: sum(maker.state not in SETTLED for maker in new)})
    reset_to_pending(tx, makers)


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
    """Check datasets that existed before the submission of a live job, and end the jobs or
    recompute what is damaged.

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
            with context.transaction() as tx:
                end_made(tx, made, damaged)


def end_made(tx: QueueTransaction, made: Any, damaged: Mapping[str, Sha256] | None) -> None:
    """End a job (a row of `_MADE_JOBS`) whose dataset is intact.

    Otherwise reset the tasks that made the damaged files.

    `damaged` has the paths and digests of the damaged files; None if the manifest itself cannot be
    trusted.
    """
    if made not in _MADE_JOBS.rows(tx.connection):
        return  # cancelled, or ended by another check
    if damaged is not None and not damaged:
        own = dataset_versions.c.publish_task == made.publish_task
        tx.connection.execute(
            update(dataset_versions).where(own).values(scrubbed_at=tx.now, damaged=0)
        )
        tx.complete_job(
            made.seq, find_committed(tx.connection, made.publish_task), "every result was cached"
        )
        return
    what = "its manifest was" if damaged is None else f"{len(damaged)} of its files were"
    message = f"the dataset was made before, but {what} damaged or lost in the store; missing files are recomputed"
    tx.set_job_state(made.seq, JobState.queued, message=message)
    reset_to_pending(tx, [Task(made.publish_task, Stage.publish, TaskState.succeeded)])
    recompute(tx, made.publish_task, damaged.values() if damaged else ())


def reset_to_pending(tx: QueueTransaction, makers: Iterable[Any]) -> None:
    """Let ended tasks that a live job needs run again, with all their tries.

    Their outputs stay until then.
    """
    ended = [maker for maker in makers if maker.state in FINISHED]
    job_of = live_jobs(tx.connection, [maker.seq for maker in ended])
    ended = [maker for maker in ended if maker.seq in job_of]
    settled = [maker.seq for maker in ended if maker.state in SETTLED]
    edges = rows_with(
        tx.connection, select(task_dependencies.c.task), task_dependencies.c.depends_on, settled
    )
    add_dependencies(tx, Counter(edge.task for edge in edges))
    assign(tx.connection, job_of)
    tx.set_task_state(ended, TaskState.pending, **RESET_ATTEMPTS)


def _find_makers(tx: QueueTransaction, consumer: int, digests: set[Sha256]) -> list[Any]:
    """Return the tasks that made `digests`, searched breadth-first among the dependencies of
    `consumer`.
    """
    edge = task_dependencies.c.depends_on == tasks.c.seq
    needed = select(*TASK_COLUMNS, tasks.c.output).join(task_dependencies, edge).distinct()
    makers: list[Any] = []
    level, seen = {consumer}, {consumer}
    while level and digests:
        below: set[int] = set()
        for row in rows_with(tx.connection, needed, task_dependencies.c.task, level):
            made = digests.intersection(DIGEST.findall(row.output or ""))
            if row.seq not in seen and made:
                makers.append(row)
                digests = digests - made
            below.add(row.seq)
        level = below - seen
        seen |= below
    return makers


_WAIT_FOR = Prepared(
    update(tasks)
    .where(tasks.c.seq == bindparam("b_seq"))
    .values(waiting_on=tasks.c.waiting_on + bindparam("b_more"))
)


def add_dependencies(tx: QueueTransaction, more: Mapping[int, int]) -> None:
    """Add to the number of tasks that each task waits for."""
    _WAIT_FOR.run_all(
        tx.connection, [{"b_seq": task, "b_more": n} for task, n in more.items() if n]
    )


def terms_of(row: Any) -> tuple[JobSpec, Terms | None]:
    """Return spec and terms of a row of `jobs`; raise DamagedRowsError."""
    if row_digest(row.spec, row.builds, row.certificate) != row.digest:
        raise DamagedRowsError
    terms = (
        None
        if row.builds is None
        else Terms(Builds.model_validate_json(row.builds), row.certificate)
    )
    return job_spec_adapter.validate_json(row.spec), terms


def read_plan(connection: Connection, job: int) -> tuple[JobSpec, Terms]:
    """Return spec and terms of a planned job; raise DamagedRowsError."""
    spec, terms = terms_of(connection.execute(select(jobs).where(jobs.c.seq == job)).one())
    assert terms is not None
    return spec, terms


def check_samples(rows: Sequence[Any], slots: Iterable[int]) -> None:
    """Raise DamagedRowsError where rows of `samples` are damaged, or are not those of `slots`, in
    order.
    """
    digests = [row_digest(*(getattr(row, name) for name in SAMPLE_COLUMNS)) for row in rows]
    if [row.slot for row in rows] != list(slots) or [row.digest for row in rows] != digests:
        raise DamagedRowsError


def check_results(rows: Sequence[Any]) -> None:
    """Raise DamagedRowsError where rows of settled `tasks` are damaged in what the task made."""
    if damaged := [row.seq for row in rows if result_digest(row, row.state) != row.digest]:
        raise DamagedRowsError(damaged)


def result_digest(row: Any, state: str) -> int:
    """Return the digest of what a task made, if it settled in `state`."""
    return row_digest(row.key, state, row.reason, row.message, row.output)


def fail_damaged_jobs(context: Context) -> None:
    """Fail the live jobs whose terms are damaged: nobody can say what they should make."""
    with context.database.read() as connection:
        rows = connection.execute(select(jobs).where(jobs.c.state.in_(LIVE))).all()
    damaged = [
        row.seq for row in rows if row_digest(row.spec, row.builds, row.certificate) != row.digest
    ]
    if damaged:
        with context.transaction() as tx:
            for job in damaged:
                tx.end_job(job, JobState.failed, Reason.storage_error, str(DamagedRowsError()))


def recompute_damaged_rows(tx: QueueTransaction, consumer: int, results: Sequence[int]) -> None:
    """Let tasks make their damaged results again, and `consumer` wait for them.

    A rejected simulation is repeated, too, since it rejects its renders.
    """
    needed = select(task_dependencies.c.depends_on).where(task_dependencies.c.task.in_(results))
    rejecting = tasks.c.seq.in_(needed), tasks.c.state == TaskState.rejected
    makers = []
    for row in tx.connection.execute(
        select(tasks).where(or_(tasks.c.seq.in_(results), and_(*rejecting)))
    ).all():
        whole = [state for state in SETTLED if result_digest(row, state) == row.digest]
        state = [
            *whole,
            *(state for state in TaskState if state == row.state),
            TaskState.succeeded,
        ][0]
        tx.connection.execute(update(tasks).where(tasks.c.seq == row.seq).values(state=state))
        makers.append(Task(row.seq, row.stage, state))
    rerun_producers(tx, consumer, makers)
