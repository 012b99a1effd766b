"""Event streams: what was written of a job since some event, then what happens, until the job ends.

A stream holds no database connection while it waits, and it waits for the bell, not in a loop. Progress is a picture of
the present, so it is not stored and does not have an id of its own: it carries that of the event before it.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass

from fastapi.responses import StreamingResponse
from sqlalchemy import Connection
from starlette.concurrency import run_in_threadpool
from stickslip_schemas.events import EventName, JobProgressEvent
from stickslip_schemas.responses import JobDetail

from stickslip_services.database.database import Database
from stickslip_services.queue.bell import Bell
from stickslip_services.queue.events import StoredEvent, read_events

RECONNECT_MILLISECONDS = 1000
KEEP_ALIVE_SECONDS = 15.0
PROGRESS_SECONDS = 1.0
LOOK_SECONDS = 0.2
BATCH = 200


OPENAPI = {
    # Each event of the stream; OpenAPI 3.2 calls it `itemSchema`.
    "schema": {
        "type": "object",
        "properties": {
            "id": {"type": "string", "pattern": "^[0-9]{1,18}$"},
            "event": {"enum": [name.value for name in EventName]},
            "data": {"type": "string", "contentMediaType": "application/json"},
            "retry": {"type": "integer"},
        },
        "required": ["data"],
    }
}

Show = Callable[[Connection, int], JobDetail]
"""Returns a job as a transaction sees it."""


def stream(database: Database, bell: Bell, show: Show, job: int, *, after: int) -> StreamingResponse:
    """Answer with the events of a job after the one with the id `after`."""
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}  # no proxy is to hold events back
    return StreamingResponse(_events(database, bell, show, job, after), headers=headers, media_type="text/event-stream")


@dataclass(frozen=True, slots=True)
class _News:
    events: list[StoredEvent]
    progress: str | None
    ended: bool


def _read(database: Database, show: Show, job: int, after: int, *, with_progress: bool) -> _News:
    with database.read() as connection:
        events = read_events(connection, job, after=after, limit=BATCH)
        shown = show(connection, job)
    ended = shown.state.is_terminal and len(events) < BATCH
    progress = JobProgressEvent(progress=shown.progress).model_dump_json() if with_progress or ended else None
    return _News(events, progress, ended)


async def _events(database: Database, bell: Bell, show: Show, job: int, cursor: int) -> AsyncIterator[bytes]:
    opening = f"retry: {RECONNECT_MILLISECONDS}\n".encode()  # goes with the first event
    told = ""
    told_at = -PROGRESS_SECONDS
    spoken_at = time.monotonic()
    while True:
        rung = bell.rung
        now = time.monotonic()
        is_progress_due = now - told_at >= PROGRESS_SECONDS
        news = await run_in_threadpool(_read, database, show, job, cursor, with_progress=is_progress_due)
        messages: list[bytes] = []
        last: list[bytes] = []  # the end of the job is the last event, also after the progress that goes with it
        for event in news.events:
            cursor = event.id
            (last if event.is_last else messages).append(_message(event.name, event.data, cursor))
        if news.progress is not None and news.progress != told and (last or not news.ended):
            told, told_at = news.progress, now
            messages.append(_message(EventName.job_progress, news.progress, cursor - 1 if last else cursor))
        if messages or last:
            messages.insert(0, opening)
            opening = b""
        elif now - spoken_at >= KEEP_ALIVE_SECONDS:
            messages.append(b": still here\n\n")
        if messages:
            spoken_at = now
            yield b"".join([*messages, *last])
        if news.ended:
            return
        if len(news.events) == BATCH:
            continue
        # A busy queue rings all the time; a few looks a second are enough for people.
        await asyncio.sleep(LOOK_SECONDS)
        due_in = KEEP_ALIVE_SECONDS if is_progress_due else told_at + PROGRESS_SECONDS - time.monotonic()
        await bell.wait(rung, max(0.0, min(due_in, spoken_at + KEEP_ALIVE_SECONDS - time.monotonic())))


def _message(name: EventName, data: str, identifier: int) -> bytes:
    return f"id: {identifier}\nevent: {name}\ndata: {data}\n\n".encode()
