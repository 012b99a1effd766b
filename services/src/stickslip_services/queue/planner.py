"""Planning jobs of many samples in the background, piece by piece, each in a transaction of its own.

Of several coordinators one plans a job at a time: it has claimed the job, and renews the claim with each piece. When it
dies, another one, or its successor, goes on after the last piece that was written.
"""

import json
import logging
from collections.abc import Callable, Iterator

from sqlalchemy import Connection, Row, or_, select, update
from sqlalchemy.exc import SQLAlchemyError
from stickslip_schemas import tracing
from stickslip_schemas.base.states import JobState, Stage
from stickslip_schemas.kinds import job_spec_adapter
from stickslip_schemas.plan.builds import Builds

from stickslip_services.clock import Clock
from stickslip_services.database.database import Database
from stickslip_services.database.prepared import Prepared
from stickslip_services.database.tables import job_tasks, jobs, tasks
from stickslip_services.queue.ids import new_id
from stickslip_services.queue.plan import Plan, Terms
from stickslip_services.queue.planning import collector_at_rest, pieces
from stickslip_services.settings import Settings

logger = logging.getLogger(__name__)

_WAITING = Prepared(select(jobs.c.seq).where(jobs.c.state == JobState.planning).limit(1))


def release_claims(connection: Connection) -> None:
    """Let every job be planned by whoever comes first: for a coordinator that is alone, and so its own successor."""
    connection.execute(update(jobs).where(jobs.c.planner.is_not(None)).values(planner=None, planner_until=None))


class Planner:
    """Plans the jobs that are `planning`: those of the highest priority first, and of these the oldest."""

    def __init__(
        self,
        database: Database,
        clock: Clock,
        settings: Settings,
        ring: Callable[[], None],
        *,
        write: Callable[[Connection, int, Plan], None],
        fail: Callable[[Connection, int, str], None],
    ) -> None:
        """`write` adds the tasks of a piece to a job, `fail` ends a job with a message, both within a transaction."""
        self._database = database
        self._clock = clock
        self._settings = settings
        self._ring = ring
        self._write_piece, self._end_job = write, fail
        self._name = new_id("planner")
        self._job: int | None = None
        self._end = 0
        self._pieces: Iterator[Plan] = iter(())

    def step(self) -> bool:
        """Plan a piece of a job; return whether there was any to plan."""
        with self._database.read() as connection:
            if _WAITING.scalar(connection) is None:
                return False
        with self._database.write() as connection:
            row = self._claim(connection)
            packed = [] if row is None or self._goes_on(row) else _pack_keys(connection, row.seq)
        if row is None:
            self._job, self._pieces = None, iter(())
            return False
        try:
            with collector_at_rest():
                if not self._goes_on(row):
                    self._pieces = self._begin(row, packed)
                with tracing.span("plan", parent=row.traceparent, job=row.id, first=row.planned):
                    piece = next(self._pieces)
                    self._write(row.seq, piece)
        except Exception as error:
            self._job = None
            if isinstance(error, OSError | SQLAlchemyError):
                raise  # the disk or the database: the next time it may go
            logger.exception("job %s cannot be planned", row.id)
            self._fail(row, error)
        self._ring()
        return True

    def _claim(self, connection: Connection) -> Row[tuple[object, ...]] | None:
        """Claim a job that nobody plans, or whose claim is over, and return its row."""
        now = self._clock()
        free = or_(jobs.c.planner.is_(None), jobs.c.planner == self._name, jobs.c.planner_until <= now)
        row = connection.execute(
            select(jobs)
            .where(jobs.c.state == JobState.planning, free)
            .order_by(jobs.c.priority.desc(), jobs.c.seq)
            .limit(1)
        ).one_or_none()
        if row is not None:
            until = now + self._settings.lease_seconds
            connection.execute(
                update(jobs).where(jobs.c.seq == row.seq).values(planner=self._name, planner_until=until)
            )
        return row

    def _goes_on(self, row: Row[tuple[object, ...]]) -> bool:
        return (row.seq, row.planned) == (self._job, self._end)

    def _begin(self, row: Row[tuple[object, ...]], packed: list[str]) -> Iterator[Plan]:
        terms = Terms(Builds.model_validate_json(row.builds), row.certificate)
        self._job, self._end = row.seq, row.planned
        return pieces(
            job_spec_adapter.validate_json(row.spec),
            terms,
            size=self._settings.plan_samples,
            previews=self._settings.previews_per_job,
            first=row.planned,
            packed=packed,
        )

    def _write(self, job: int, piece: Plan) -> None:
        with self._database.write() as connection:
            still = (jobs.c.seq == job, jobs.c.state == JobState.planning, jobs.c.planner == self._name)
            if connection.scalar(select(jobs.c.planned).where(*still)) != piece.first:
                self._job = None  # paused, cancelled or failed meanwhile, or another coordinator goes on with it
                return
            self._write_piece(connection, job, piece)
        self._end = piece.end

    def _fail(self, row: Row[tuple[object, ...]], error: Exception) -> None:
        message = f"planning it failed after {row.planned} of {row.sample_count} samples: {error}"[:2000]
        with self._database.write() as connection:
            if connection.scalar(select(jobs.c.state).where(jobs.c.seq == row.seq)) == JobState.planning:
                self._end_job(connection, row.seq, message)


def _pack_keys(connection: Connection, job: int) -> list[str]:
    """Return the keys of the pack tasks that a job has so far, by shard."""
    rows = connection.execute(
        select(tasks.c.key, tasks.c.payload)
        .join(job_tasks, job_tasks.c.task == tasks.c.seq)
        .where(job_tasks.c.job == job, tasks.c.stage == Stage.pack)
    )
    by_shard = {json.loads(payload)["shard"]: key.hex() for key, payload in rows}
    return [by_shard[shard] for shard in sorted(by_shard)]
