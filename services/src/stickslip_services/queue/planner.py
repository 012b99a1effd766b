"""Planning in the background: jobs that waited for the first worker, and jobs of many samples.

A job of many samples is planned piece by piece, each piece in a transaction of its own. Of several coordinators one
plans a job at a time: it claims the job, and renews the claim with each piece. When it dies, another coordinator, or
its successor, continues after the last piece that was written.
"""

import json
import logging
from collections.abc import Iterator

from sqlalchemy import Connection, Row, or_, select, update
from sqlalchemy.exc import SQLAlchemyError
from stickslip_schemas.base import JobState, Reason, Stage
from stickslip_schemas.spec.jobs import JobSpec

from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_tasks, jobs, tasks
from stickslip_services.errors import KindNotAvailableError, PresetNotCertifiedError
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import new_id
from stickslip_services.queue.jobs import unplanned_jobs
from stickslip_services.queue.plan import Plan, Terms, expand, pieces, terms_for
from stickslip_services.queue.recompute import terms_of
from stickslip_services.queue.workers import present_workers
from stickslip_services.queue.write_plan import begin_planning, write_plan

logger = logging.getLogger(__name__)

_WAITING = Prepared(select(jobs.c.seq).where(jobs.c.state == JobState.planning).limit(1))


def release_claims(connection: Connection) -> None:
    """Release the claims of all planners; only for a coordinator that is alone on its database."""
    connection.execute(update(jobs).where(jobs.c.planner.is_not(None)).values(planner=None, planner_until=None))


def plan_waiting_jobs(context: Context) -> None:
    """Plan the jobs that were submitted before the first worker registered, or fail those that cannot be planned."""
    with context.database.read() as connection:
        waiting = unplanned_jobs(connection)
        is_known = any(worker.builds for worker in present_workers(connection))
    for row in waiting if is_known else ():
        with context.ledger() as book:
            if row.seq not in {other.seq for other in unplanned_jobs(book.connection)}:
                continue  # cancelled, or planned by another coordinator
            try:
                spec, _ = terms_of(row)
                if (terms := terms_for(book.connection, spec)) is None:
                    return
                begin_planning(book, row.seq, terms, plan_at_once(context, spec, terms))
            except (KindNotAvailableError, PresetNotCertifiedError) as error:
                is_preset = isinstance(error, PresetNotCertifiedError)
                reason = Reason.preset_not_certified if is_preset else Reason.waiting_for_worker
                book.set_state(row.seq, JobState.failed, reason=reason, message=str(error))


def plan_at_once(context: Context, spec: JobSpec, terms: Terms) -> Plan | None:
    """Return the plan of a job of few samples; None of one that is planned piece by piece."""
    if spec.sample_count > context.settings.plan_samples:
        return None
    return expand(spec, terms, previews=context.settings.previews_per_job)


class Planner:
    """Plans the jobs that are `planning`: those of the highest priority first, and of these the oldest."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._name = new_id("planner")
        self._job: int | None = None
        self._end = 0
        self._pieces: Iterator[Plan] = iter(())

    def run(self) -> None:
        """Plan until no job is `planning`, or the coordinator closes."""
        while not self._context.is_closing and self.step():
            pass

    def step(self) -> bool:
        """Plan a piece of a job; return whether there was any to plan."""
        with self._context.database.read() as connection:
            if _WAITING.scalar(connection) is None:
                return False
        with self._context.database.write() as connection:
            row = self._claim(connection)
            packed = [] if row is None or self._goes_on(row) else _pack_keys(connection, row.seq)
        if row is None:
            self._job, self._pieces = None, iter(())
            return False
        try:
            if not self._goes_on(row):
                self._pieces = self._begin(row, packed)
            self._write(row.seq, next(self._pieces))
        except Exception as error:
            self._job = None
            if isinstance(error, OSError | SQLAlchemyError):
                raise  # the disk or the database: it may work the next time
            logger.exception("job %s cannot be planned", row.id)
            self._fail(row, error)
        return True

    def _claim(self, connection: Connection) -> Row[tuple[object, ...]] | None:
        """Claim a job that nobody plans, or whose claim is over, and return its row."""
        now = self._context.clock()
        free = or_(jobs.c.planner.is_(None), jobs.c.planner == self._name, jobs.c.planner_until <= now)
        row = connection.execute(
            select(jobs)
            .where(jobs.c.state == JobState.planning, free)
            .order_by(jobs.c.priority.desc(), jobs.c.seq)
            .limit(1)
        ).one_or_none()
        if row is not None:
            until = now + self._context.settings.lease_seconds
            connection.execute(
                update(jobs).where(jobs.c.seq == row.seq).values(planner=self._name, planner_until=until)
            )
        return row

    def _goes_on(self, row: Row[tuple[object, ...]]) -> bool:
        return (row.seq, row.planned) == (self._job, self._end)

    def _begin(self, row: Row[tuple[object, ...]], packed: list[str]) -> Iterator[Plan]:
        spec, terms = terms_of(row)
        assert terms is not None
        self._job, self._end = row.seq, row.planned
        return pieces(
            spec,
            terms,
            size=self._context.settings.plan_samples,
            previews=self._context.settings.previews_per_job,
            first=row.planned,
            packed=packed,
        )

    def _write(self, job: int, piece: Plan) -> None:
        with self._context.ledger() as book:
            still = (jobs.c.seq == job, jobs.c.state == JobState.planning, jobs.c.planner == self._name)
            if book.connection.scalar(select(jobs.c.planned).where(*still)) != piece.first:
                self._job = None  # paused, cancelled or failed meanwhile, or another coordinator goes on with it
                return
            write_plan(book, job, piece)
        self._end = piece.end
        if piece.is_last or piece.end.bit_length() > piece.first.bit_length():  # at each power of two
            self._context.database.analyse()

    def _fail(self, row: Row[tuple[object, ...]], error: Exception) -> None:
        message = f"planning it failed after {row.planned} of {row.sample_count} samples: {error}"[:2000]
        with self._context.ledger() as book:
            if book.connection.scalar(select(jobs.c.state).where(jobs.c.seq == row.seq)) == JobState.planning:
                book.end(row.seq, JobState.failed, Reason.internal_error, message)


def _pack_keys(connection: Connection, job: int) -> list[str]:
    """Return the keys of the pack tasks that a job has so far, by shard."""
    rows = connection.execute(
        select(tasks.c.key, tasks.c.payload)
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.stage == Stage.pack)
    )
    by_shard = {json.loads(payload)["shard"]: key.hex() for key, payload in rows}
    return [by_shard[shard] for shard in sorted(by_shard)]
