"""States and events of jobs. An event is stored in the transaction of the change, and read by event streams.

Progress is not stored: it is read from the counters while a job is watched.
"""

from dataclasses import dataclass

from sqlalchemy import Connection, func, insert, select, update
from stickslip_schemas.base.document import Document
from stickslip_schemas.base.states import JobState, Reason
from stickslip_schemas.documents.responses import EventName, JobStateEvent

from stickslip_services.database.tables import events, jobs
from stickslip_services.queue.ledger import Ledger


@dataclass(frozen=True, slots=True)
class StoredEvent:
    """An event as the stream sends it; `data` is JSON."""

    id: int
    name: EventName
    data: str

    @property
    def is_last(self) -> bool:
        return self.name is EventName.job_state and not JobStateEvent.model_validate_json(self.data).state.is_open


def set_job_state(book: Ledger, job: int, state: JobState, *, reason: Reason | None = None, message: str = "") -> None:
    """Set the state of a job with its reason and message, and store the event."""
    values: dict[str, object] = {"state": state, "reason": reason, "message": message}
    if state is JobState.running:
        values["started_at"] = func.coalesce(jobs.c.started_at, book.now)
    if not state.is_open:
        values["finished_at"] = book.now
    book.connection.execute(update(jobs).where(jobs.c.seq == job).values(values))
    append_event(book, job, EventName.job_state, JobStateEvent(state=state, reason=reason, message=message))


def read_events(connection: Connection, job: int, *, after: int, limit: int) -> list[StoredEvent]:
    """Return the events of a job after the one with the id `after`."""
    rows = connection.execute(
        select(events.c.id, events.c.name, events.c.data)
        .where(events.c.job == job, events.c.id > after)
        .order_by(events.c.id)
        .limit(limit)
    )
    return [StoredEvent(row.id, EventName(row.name), row.data) for row in rows]


def append_event(book: Ledger, job: int, name: EventName, data: Document) -> None:
    row = {"job": job, "name": name, "data": data.model_dump_json(), "created_at": book.now}
    book.connection.execute(insert(events).values(row))
