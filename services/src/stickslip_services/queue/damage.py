"""Rows that cannot lie: what a dataset is made from is checked when it is read from the database.

A bit that flips in a row shows. The content key of a task is the digest of what it is; what it made, the rows of
samples, and the terms of a job have digests beside them. A damaged result is recomputed, as a damaged artifact
is. Where other rows are damaged the job fails; its spec, submitted again, writes them anew.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from sqlalchemy import Connection, and_, or_, select, update
from stickslip_schemas.base.states import JobState, Reason, Stage, TaskState
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.database.tables import jobs, task_dependencies, tasks
from stickslip_services.errors import DamagedRowsError
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import SAMPLE_COLUMNS, row_digest
from stickslip_services.queue.ledger import LIVE, Ending, Ledger, Task
from stickslip_services.queue.plan import Terms
from stickslip_services.queue.recompute import remake


def terms_of(row: Any) -> tuple[JobSpec, Terms | None]:
    """Return spec and terms of a row of `jobs`; raise DamagedRowsError."""
    if row_digest(row.spec, row.builds, row.certificate) != row.digest:
        raise DamagedRowsError
    terms = None if row.builds is None else Terms(Builds.model_validate_json(row.builds), row.certificate)
    return job_spec_adapter.validate_json(row.spec), terms


def read_plan(connection: Connection, job: int) -> tuple[JobSpec, Terms]:
    """Return spec and terms of a planned job; raise DamagedRowsError."""
    spec, terms = terms_of(connection.execute(select(jobs).where(jobs.c.seq == job)).one())
    assert terms is not None
    return spec, terms


def check_samples(rows: Sequence[Any], slots: Iterable[int]) -> None:
    """Raise DamagedRowsError where rows of `samples` are damaged, or are not those of `slots`, in order."""
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
    damaged = [row.seq for row in rows if row_digest(row.spec, row.builds, row.certificate) != row.digest]
    if damaged:
        with context.ledger() as book:
            for job in damaged:
                book.end_job(job, Ending(JobState.failed, Reason.storage_error, str(DamagedRowsError())))


def mend(book: Ledger, consumer: int, results: Sequence[int]) -> None:
    """Let tasks make their damaged results again, and `consumer` wait for them.

    A rejected simulation is repeated, too, since it rejects its renders.
    """
    needed = select(task_dependencies.c.depends_on).where(task_dependencies.c.task.in_(results))
    rejecting = tasks.c.seq.in_(needed), tasks.c.state == TaskState.rejected
    makers = []
    for row in book.connection.execute(select(tasks).where(or_(tasks.c.seq.in_(results), and_(*rejecting)))).all():
        whole = [state for state in TaskState if state.is_settled and result_digest(row, state) == row.digest]
        state = [*whole, *(state for state in TaskState if state == row.state), TaskState.succeeded][0]
        book.connection.execute(update(tasks).where(tasks.c.seq == row.seq).values(state=state))
        makers.append(Task(row.seq, Stage(row.stage), state))
    remake(book, consumer, makers)
