"""Planning in the background: jobs that waited for the first worker, and jobs of many samples.

A job of many samples is planned piece by piece, each piece in a transaction of its own. Of several
coordinators one plans a job at a time: it claims the job, and renews the claim with each piece.
When it dies, another coordinator, or its successor, continues after the last inserted piece.
"""

import json
import logging
from collections.abc import Iterator
from typing import NamedTuple

from sqlalchemy import Connection, bindparam, or_, select, text, update
from sqlalchemy.exc import SQLAlchemyError
from stickslip_schemas.base import JobState, Reason

from stickslip_services.database.statements import RowQuery, ValueQuery
from stickslip_services.database.tables import jobs
from stickslip_services.errors import (
    DamagedRowError,
    KindNotAvailableError,
    PresetNotCertifiedError,
)
from stickslip_services.queue.context import Context
from stickslip_services.queue.ids import new_id
from stickslip_services.queue.insertion import begin_planning, insert_piece
from stickslip_services.queue.integrity import plan_inputs_of, spec_of
from stickslip_services.queue.job_states import end_job
from stickslip_services.queue.plan import Plan, pieces, plan_at_once, plan_inputs_for
from stickslip_services.queue.rows import JobRow, job_columns
from stickslip_services.queue.transaction import QueueTransaction
from stickslip_services.queue.workers import present_workers

logger = logging.getLogger(__name__)

MAX_MESSAGE = 2000
"""Length of the message of a job that cannot be planned [characters]."""

_ANY_PLANNING_JOB: ValueQuery[int] = ValueQuery(
    "SELECT seq FROM jobs WHERE jobs.finished_at IS NULL AND state = 'planning' LIMIT 1"
)
_ANY_UNPLANNED_JOB: ValueQuery[int] = ValueQuery(
    "SELECT seq FROM jobs WHERE jobs.finished_at IS NULL AND jobs.builds IS NULL LIMIT 1"
)
_IS_UNPLANNED = (
    text("jobs.finished_at IS NULL AND jobs.builds IS NULL"),
    jobs.c.state == JobState.queued.value,
)
_UNPLANNED_JOBS = RowQuery(
    JobRow, select(*job_columns(JobRow)).where(*_IS_UNPLANNED).order_by(jobs.c.seq)
)
_UNPLANNED_JOB = RowQuery(
    JobRow,
    select(*job_columns(JobRow)).where(*_IS_UNPLANNED, jobs.c.seq == bindparam("b_job")),
)


class _PackTask(NamedTuple):
    key: bytes
    payload: str


_PACK_TASKS = RowQuery(
    _PackTask,
    "SELECT tasks.key, tasks.payload FROM job_tasks JOIN tasks ON tasks.seq = job_tasks.task "
    "WHERE job_tasks.job = :b_job AND tasks.stage = 'pack'",
)


def release_claims(connection: Connection) -> None:
    """Release the claims of all planners; only for a coordinator that is alone on its database."""
    claimed = update(jobs).where(jobs.c.planner.is_not(None))
    connection.execute(claimed.values(planner=None, planner_until=None))


def plan_waiting_jobs(context: Context) -> None:
    """Plan the jobs that were submitted before the first worker registered.

    Fails the jobs that cannot be planned.
    """
    with context.database.read() as connection:
        # Without a worker thousands of jobs may wait: ask for all of them only if there is one.
        if _ANY_UNPLANNED_JOB.first(connection) is None:
            return
        if not any(worker.builds for worker in present_workers(connection)):
            return
        waiting = _UNPLANNED_JOBS.rows(connection)
    for row in waiting:
        with context.transaction() as tx:
            # None: cancelled, paused, or planned by another coordinator.
            if _UNPLANNED_JOB.first(tx.connection, {"b_job": row.seq}) is not None:
                _plan_waiting_job(context, tx, row)


def _plan_waiting_job(context: Context, tx: QueueTransaction, row: JobRow) -> None:
    try:
        spec = spec_of(row)
        inputs = plan_inputs_for(tx.connection, spec)
    except DamagedRowError as error:
        end_job(tx, row.seq, JobState.failed, Reason.damaged_row, str(error))
    except PresetNotCertifiedError as error:
        end_job(tx, row.seq, JobState.failed, Reason.preset_not_certified, str(error))
    except KindNotAvailableError as error:
        end_job(tx, row.seq, JobState.failed, Reason.waiting_for_worker, str(error))
    else:
        if inputs is not None:
            begin_planning(tx, row.seq, inputs, plan_at_once(context.settings, spec, inputs))


class Planner:
    """Plans the `planning` jobs, the highest priority first, and of equal ones the oldest first."""

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
        """Plan a piece of a job, and return whether there was any to plan."""
        with self._context.database.read() as connection:
            if _ANY_PLANNING_JOB.first(connection) is None:
                return False
        with self._context.database.write() as connection:
            row = self._claim(connection)
            packed: list[str] = []
            if row is not None and not self._continues(row):
                packed = _pack_keys(connection, row.seq)
        if row is None:
            self._job = None
            self._pieces = iter(())
            return False

        try:
            if not self._continues(row):
                self._pieces = self._begin(row, packed)
            self._insert(row.seq, next(self._pieces))
        except DamagedRowError as error:
            self._fail(row, Reason.damaged_row, str(error))
        except (OSError, SQLAlchemyError):
            self._job = None
            raise  # the disk or the database: it may work the next time
        except Exception as error:
            logger.exception("job %s cannot be planned", row.id)
            position = f"after {row.planned} of {row.sample_count} samples"
            self._fail(row, Reason.internal_error, f"planning it failed {position}: {error}")
        return True

    def _claim(self, connection: Connection) -> JobRow | None:
        """Claim a job that nobody plans, or whose claim is over, and return its row."""
        now = self._context.clock()
        row = _FREE_JOBS.first(connection, {"b_planner": self._name, "b_now": now})
        if row is not None:
            until = now + self._context.settings.lease_seconds
            claim = update(jobs).where(jobs.c.seq == row.seq)
            connection.execute(claim.values(planner=self._name, planner_until=until))
        return row

    def _continues(self, row: JobRow) -> bool:
        """Return whether a job is the job of the last step, and nobody else has planned it."""
        return (row.seq, row.planned) == (self._job, self._end)

    def _begin(self, row: JobRow, packed: list[str]) -> Iterator[Plan]:
        spec = spec_of(row)
        inputs = plan_inputs_of(row)
        assert inputs is not None, "a job that is `planning` has the inputs of its plan"
        self._job = row.seq
        self._end = row.planned
        settings = self._context.settings
        return pieces(
            spec,
            inputs,
            size=settings.plan_samples,
            previews=settings.previews_per_job,
            first=row.planned,
            packed=packed,
        )

    def _insert(self, job: int, piece: Plan) -> None:
        with self._context.transaction() as tx:
            is_claimed = (
                jobs.c.seq == job,
                jobs.c.state == JobState.planning,
                jobs.c.planner == self._name,
            )
            planned = tx.connection.scalar(select(jobs.c.planned).where(*is_claimed))
            if planned != piece.first:
                # Paused, cancelled or failed meanwhile, or another coordinator continues it.
                self._job = None
                return
            insert_piece(tx, job, piece)
        self._end = piece.end
        # The tables have grown by half: the database must know that to choose plans.
        is_last = piece.publish_key is not None
        if is_last or piece.end.bit_length() > piece.first.bit_length():
            self._context.database.analyse()

    def _fail(self, row: JobRow, reason: Reason, message: str) -> None:
        self._job = None
        with self._context.transaction() as tx:
            state = tx.connection.scalar(select(jobs.c.state).where(jobs.c.seq == row.seq))
            if state == JobState.planning:
                end_job(tx, row.seq, JobState.failed, reason, message[:MAX_MESSAGE])


_FREE_JOBS = RowQuery(
    JobRow,
    select(*job_columns(JobRow))
    .where(
        text("jobs.finished_at IS NULL"),
        jobs.c.state == JobState.planning.value,
        or_(
            jobs.c.planner.is_(None),
            jobs.c.planner == bindparam("b_planner"),
            jobs.c.planner_until <= bindparam("b_now"),
        ),
    )
    .order_by(jobs.c.priority.desc(), jobs.c.seq)
    .limit(1),
)


def _pack_keys(connection: Connection, job: int) -> list[str]:
    """Return the keys of the pack tasks that a job has so far, by shard."""
    key_of_shard: dict[int, str] = {}
    for key, payload in _PACK_TASKS.rows(connection, {"b_job": job}):
        key_of_shard[json.loads(payload)["shard"]] = key.hex()
    return [key_of_shard[shard] for shard in sorted(key_of_shard)]
