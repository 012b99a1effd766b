"""Removal of ended jobs from the queue, piece by piece.

A job of a million tasks may have half a million rows in `ready_tasks` when it is cancelled. Nobody
reads them, so nobody waits for their removal. A piece takes a few milliseconds of the write lock,
and others write between two pieces. `jobs.leaves_queue` says which jobs have rows left. So a
coordinator that dies leaves the rest of the work to the next one.
"""

import time
from typing import NamedTuple

from sqlalchemy import Connection
from stickslip_schemas.base import Stage

from stickslip_services.database.statements import Statement, ValueQuery
from stickslip_services.queue.context import Context

PIECE = 1000
"""Rows of a piece. It takes 2 ms of CPU; larger pieces cost no less a row."""

REST_SECONDS = 0.02
"""Pause after a piece, in which others write [s]."""

_LEAVING_JOB: ValueQuery[int] = ValueQuery(
    "SELECT seq FROM jobs WHERE leaves_queue ORDER BY seq LIMIT 1"
)
# Both statements read a range of the index (job, stage, task).
_LAST_OF_PIECE: ValueQuery[int | None] = ValueQuery(
    "SELECT max(task) FROM (SELECT task FROM ready_tasks "
    "WHERE job = :b_job AND stage = :b_stage AND task > :b_after ORDER BY task LIMIT :b_count) "
    "AS piece"
)
_REMOVE_PIECE = Statement(
    "DELETE FROM ready_tasks "
    "WHERE job = :b_job AND stage = :b_stage AND task > :b_after AND task <= :b_last"
)
_HAS_LEFT = Statement("UPDATE jobs SET leaves_queue = false WHERE seq = :b_job")


class _Position(NamedTuple):
    """The place in the queue up to which the rows of a job are removed."""

    job: int
    stage: Stage
    task: int


class QueueCleaner:
    """Removes the rows of ended jobs from `ready_tasks`."""

    def __init__(self, context: Context, *, piece: int = PIECE) -> None:
        self._context = context
        self._piece = piece
        # PostgreSQL keeps deleted rows in its index for a while. A piece that searched from the
        # beginning would read all of them again.
        self._position: _Position | None = None

    def run(self) -> None:
        """Remove rows until no ended job has any, or the coordinator closes."""
        while not self._context.is_closing and self.step():
            time.sleep(REST_SECONDS)

    def step(self) -> bool:
        """Remove a piece, and return whether there may be another."""
        with self._context.database.read() as connection:
            job = _LEAVING_JOB.first(connection)
        if job is None:
            self._position = None
            return False
        position = self._position
        if position is None or position.job != job:
            position = _Position(job, next(iter(Stage)), 0)
        # Progress does not show the queue, so nobody is notified.
        with self._context.database.write() as connection:
            self._position = self._remove(connection, position)
        return True

    def _remove(self, connection: Connection, position: _Position) -> _Position | None:
        """Remove a piece, and return the position after it; None at the end of the job."""
        stages = list(Stage)
        for stage in stages[stages.index(position.stage) :]:
            after = position.task if stage is position.stage else 0
            key: dict[str, object] = {"b_job": position.job, "b_stage": stage, "b_after": after}
            last = _LAST_OF_PIECE.first(connection, {**key, "b_count": self._piece})
            if last is not None:
                _REMOVE_PIECE.run(connection, {**key, "b_last": last})
                return _Position(position.job, stage, last)
        _HAS_LEFT.run(connection, {"b_job": position.job})
        return None
