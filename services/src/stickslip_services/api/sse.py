"""Event streams: the stored events of a job after a given one, then new events until the job ends.

All watchers of a job share one feed, which alone reads the database, so a thousand watchers cost no
more than one. A feed holds no database connection while it waits for the notifier. Progress is not
stored and has no id of its own: it carries that of the event before it.
"""

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator
from typing import ClassVar

from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool
from starlette.types import ASGIApp, Receive, Scope, Send
from stickslip_schemas.documents.problems import ProblemCode
from stickslip_schemas.documents.responses import EventName, JobProgressEvent

from stickslip_services.access.principals import current_principal
from stickslip_services.api.problems import ProblemError
from stickslip_services.queue.context import Context
from stickslip_services.queue.jobs import StoredEvent, read_events, show_job

RECONNECT_MILLISECONDS = 1000
KEEP_ALIVE_SECONDS = 15.0
PROGRESS_SECONDS = 1.0
LOOK_SECONDS = 0.2
BATCH = 200
MOST_STREAMS = 500
"""Event streams of one key, and of one address."""
ALL_STREAMS = 2000
"""Event streams of all: half of all connections, so that streams never keep other requests out."""

OPENAPI = {
    # The schema of one event; OpenAPI 3.2 has `itemSchema` for it.
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


class EventStream(StreamingResponse):
    """A stream of events; 429 where its key or its address has as many as it may."""

    _open: ClassVar[Counter[tuple[ASGIApp, str]]] = Counter()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        address = scope["client"][0] if scope["client"] else "no address"
        owners = {
            f"key {current_principal().name}": MOST_STREAMS,
            f"address {address}": MOST_STREAMS,
        }
        places = {
            (scope["app"], owner): most
            for owner, most in {**owners, "coordinator": ALL_STREAMS}.items()
        }
        for place, most in places.items():
            if self._open[place] >= most:
                detail = (
                    f"the {place[1]} has {most} event streams, and may have no more: close some"
                )
                headers = {"Retry-After": "60"}
                raise ProblemError(429, ProblemCode.too_many_streams, detail, headers=headers)
        self._open.update(places.keys())
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._open.subtract(places.keys())


class Feeds:
    """The feeds of watched jobs, for one event loop."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._feeds: dict[int, _Feed] = {}

    def stream(self, job: int, *, after: int) -> StreamingResponse:
        """Answer with the events of a job after the one with the id `after`."""
        headers = {
            "Cache-Control": "no-store",
            "X-Accel-Buffering": "no",
        }  # no proxy may buffer events
        return EventStream(self._watch(job, after), headers=headers, media_type="text/event-stream")

    async def _watch(self, job: int, cursor: int) -> AsyncIterator[bytes]:
        feed = self._feeds.get(job)
        if feed is None:
            feed = self._feeds[job] = _Feed(self._context, job, cursor)
        feed.watchers += 1
        try:
            async for message in feed.messages(cursor):
                yield message
        finally:
            feed.watchers -= 1
            if feed.watchers == 0:
                feed.task.cancel()
                if self._feeds.get(job) is feed:
                    del self._feeds[job]


class _Feed:
    """Events and progress of a job, kept up to date while it is watched."""

    def __init__(self, context: Context, job: int, after: int) -> None:
        self._context = context
        self._job = job
        self._after = after
        """`_events`, those of the last look, are all events after this id; older ones are read from
        the database.
        """
        self._events: list[StoredEvent] = []
        self._progress = ""
        self._is_complete = False
        """True when the job has ended and all of its events have been read."""
        self._changed = asyncio.Event()
        self.watchers = 0
        self.task = asyncio.create_task(self._follow())

    async def messages(self, cursor: int) -> AsyncIterator[bytes]:
        """Yield the messages for a watcher that has the events up to `cursor`."""
        opening = f"retry: {RECONNECT_MILLISECONDS}\n".encode()  # goes with the first event
        told = ""
        while True:
            changed = self._changed
            events = await self._events_after(cursor)
            messages: list[bytes] = []
            last: list[bytes] = []  # the end of the job comes after the progress that goes with it
            for event in events:
                cursor = event.id
                (last if event.is_last else messages).append(
                    _message(event.name, event.data, cursor)
                )
            is_up_to_date = cursor >= self._newest
            ended = self._is_complete and is_up_to_date
            if self._progress not in ("", told) and is_up_to_date and (last or not ended):
                told = self._progress
                messages.append(
                    _message(EventName.job_progress, told, cursor - 1 if last else cursor)
                )
            if messages or last:
                messages.insert(0, opening)
                opening = b""
                yield b"".join([*messages, *last])
            if ended:
                return
            if self.task.done():
                self.task.result()  # raises the error of the feed; the client reconnects
                return
            if changed is self._changed and is_up_to_date:
                try:
                    await asyncio.wait_for(changed.wait(), KEEP_ALIVE_SECONDS)
                except TimeoutError:
                    yield b": still here\n\n"

    @property
    def _newest(self) -> int:
        return self._events[-1].id if self._events else self._after

    async def _events_after(self, cursor: int) -> list[StoredEvent]:
        if cursor >= self._after:
            return [event for event in self._events if event.id > cursor]
        older = await run_in_threadpool(self._read, cursor)
        return [
            event for event in older if event.id <= self._newest
        ]  # newer ones come with their progress

    def _read(self, after: int) -> list[StoredEvent]:
        with self._context.database.read() as connection:
            return read_events(connection, self._job, after=after, limit=BATCH)

    def _look(self, *, with_progress: bool) -> tuple[list[StoredEvent], str | None, bool]:
        """Return new events, the progress if it was read, and whether the job has ended and these
        are its last.
        """
        with self._context.database.read() as connection:
            events = read_events(connection, self._job, after=self._newest, limit=BATCH)
            is_shown = with_progress or any(event.is_last for event in events)
            shown = show_job(self._context, connection, self._job) if is_shown else None
        ended = shown is not None and not shown.state.is_open and len(events) < BATCH
        progress = (
            None if shown is None else JobProgressEvent(progress=shown.progress).model_dump_json()
        )
        return events, progress, ended

    async def _follow(self) -> None:
        """Read new events until the job ends or nobody watches."""
        looked_at = -PROGRESS_SECONDS
        try:
            while not self._is_complete:
                seen = self._context.notifier.count
                now = time.monotonic()
                is_progress_due = now - looked_at >= PROGRESS_SECONDS
                events, progress, ended = await run_in_threadpool(
                    self._look, with_progress=is_progress_due
                )
                if progress is not None:
                    looked_at = now
                self._take(events, progress, ended=ended)
                if len(events) == BATCH or self._is_complete:
                    continue
                # A busy queue notifies all the time; a few looks a second are enough for people.
                await asyncio.sleep(LOOK_SECONDS)
                due_in = (
                    KEEP_ALIVE_SECONDS
                    if is_progress_due
                    else looked_at + PROGRESS_SECONDS - time.monotonic()
                )
                await self._context.notifier.wait(seen, max(0.0, due_in))
        finally:
            self._tell()

    def _take(self, events: list[StoredEvent], progress: str | None, *, ended: bool) -> None:
        is_new = bool(events) or ended or progress not in (None, self._progress)
        if events:
            self._after, self._events = self._newest, events
        self._progress = progress or self._progress
        self._is_complete = ended
        if is_new:
            self._tell()

    def _tell(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()


def _message(name: EventName, data: str, identifier: int) -> bytes:
    return f"id: {identifier}\nevent: {name}\ndata: {data}\n\n".encode()
