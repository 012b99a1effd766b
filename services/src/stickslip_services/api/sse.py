"""Event streams: the stored events of a job after a given one, then new events until the job ends.

All watchers of a job share one feed, which alone reads the database, so a thousand watchers cost no
more than one. A feed holds no database connection while it waits for the notifier. Progress is not
stored and has no id: it carries that of the event before it.
"""

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass
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
"""Wait of a client before it connects again [ms]."""

KEEP_ALIVE_SECONDS = 15.0
"""Time after which an empty message keeps proxies from closing a stream [s]."""

PROGRESS_SECONDS = 1.0
"""Least time between two reports of progress [s]."""

POLL_SECONDS = 0.2
"""Least time between two reads of new events [s]: a busy queue notifies all the time."""

BATCH = 200
"""Events that are read at once."""

MAX_OWN_STREAMS = 500
"""Event streams of one key, and of one address."""

MAX_STREAMS = 2000
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
    """A stream of events; 429 if its key or its address has as many as it may have."""

    _open: ClassVar[Counter[tuple[ASGIApp, str]]] = Counter()
    """Open streams of each application and owner."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        address = scope["client"][0] if scope["client"] else "no address"
        limits = {
            (scope["app"], f"key {current_principal().name}"): MAX_OWN_STREAMS,
            (scope["app"], f"address {address}"): MAX_OWN_STREAMS,
            (scope["app"], "coordinator"): MAX_STREAMS,
        }
        for owner, limit in limits.items():
            if self._open[owner] >= limit:
                detail = (
                    f"the {owner[1]} has {limit} event streams, and may have no more: close some"
                )
                headers = {"Retry-After": "60"}
                raise ProblemError(429, ProblemCode.too_many_streams, detail, headers=headers)
        self._open.update(limits.keys())
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._open.subtract(limits.keys())


class Feeds:
    """The feeds of watched jobs, for one event loop."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._feeds: dict[int, _Feed] = {}

    def stream(self, job: int, *, after: int) -> StreamingResponse:
        """Answer with the events of a job whose ids are above `after`."""
        # No cache may keep events, and no proxy may buffer them.
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return EventStream(self._watch(job, after), headers=headers, media_type="text/event-stream")

    async def _watch(self, job: int, cursor: int) -> AsyncIterator[bytes]:
        """Yield the messages of a job while somebody watches."""
        feed = self._feeds.get(job)
        if feed is None:
            feed = _Feed(self._context, job, cursor)
            self._feeds[job] = feed
        feed.watchers += 1
        try:
            async for message in feed.messages(cursor):
                yield message
        finally:
            # The last watcher ends the feed. A new one may have its place in the table already.
            feed.watchers -= 1
            if feed.watchers == 0:
                feed.task.cancel()
                if self._feeds.get(job) is feed:
                    del self._feeds[job]


@dataclass(frozen=True, slots=True)
class _News:
    """What one read of the database has found."""

    events: list[StoredEvent]
    progress: str | None
    """The progress as JSON; None if it was not read."""
    has_ended: bool
    """Whether the job has ended, and these events are its last."""


class _Feed:
    """Events and progress of a job, kept up to date while it is watched."""

    def __init__(self, context: Context, job: int, after: int) -> None:
        self._context = context
        self._job = job
        self._after = after
        """`_events`, those of the last read, are all events after this id; older ones are read from
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
        # Goes with the first event, since an empty message would be an event of its own.
        opening = f"retry: {RECONNECT_MILLISECONDS}\n".encode()
        reported_progress = ""
        while True:
            changed = self._changed
            events = await self._events_after(cursor)
            messages: list[bytes] = []
            # The end of the job comes after the progress that goes with it.
            last_messages: list[bytes] = []
            for event in events:
                cursor = event.id
                message = _message(event.name, event.data, cursor)
                (last_messages if event.is_last else messages).append(message)

            is_up_to_date = cursor >= self._newest
            has_ended = self._is_complete and is_up_to_date
            is_new = self._progress not in ("", reported_progress)
            # After the last event no progress may follow.
            if is_new and is_up_to_date and (last_messages or not has_ended):
                reported_progress = self._progress
                progress_id = cursor - 1 if last_messages else cursor
                messages.append(_message(EventName.job_progress, reported_progress, progress_id))
            if messages or last_messages:
                yield b"".join([opening, *messages, *last_messages])
                opening = b""
            if has_ended:
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
        """Id of the newest event that the feed has read."""
        return self._events[-1].id if self._events else self._after

    async def _events_after(self, cursor: int) -> list[StoredEvent]:
        """Return the events after one, as far as the feed has read."""
        if cursor >= self._after:
            return [event for event in self._events if event.id > cursor]
        older = await run_in_threadpool(self._read, cursor)
        # Newer ones come with their progress.
        return [event for event in older if event.id <= self._newest]

    def _read(self, after: int) -> list[StoredEvent]:
        with self._context.database.read() as connection:
            return read_events(connection, self._job, after=after, limit=BATCH)

    def _read_news(self, *, with_progress: bool) -> _News:
        """Return new events, and the progress if it is due or the job has ended."""
        with self._context.database.read() as connection:
            events = read_events(connection, self._job, after=self._newest, limit=BATCH)
            if not with_progress and not any(event.is_last for event in events):
                return _News(events, None, has_ended=False)
            job = show_job(self._context, connection, self._job)
        progress = JobProgressEvent(progress=job.progress).model_dump_json()
        # A full batch may have others after it.
        has_ended = not job.state.is_open and len(events) < BATCH
        return _News(events, progress, has_ended)

    async def _follow(self) -> None:
        """Read new events until the job ends or nobody watches."""
        progress_read_at = -PROGRESS_SECONDS
        try:
            while not self._is_complete:
                notification = self._context.notifier.count
                now = time.monotonic()
                is_due = now - progress_read_at >= PROGRESS_SECONDS
                news = await run_in_threadpool(self._read_news, with_progress=is_due)
                if news.progress is not None:
                    progress_read_at = now
                self._accept(news)
                if len(news.events) == BATCH or self._is_complete:
                    continue
                await asyncio.sleep(POLL_SECONDS)
                # Wait for the next change, or until progress that was not due is.
                wait = KEEP_ALIVE_SECONDS
                if not is_due:
                    wait = max(0.0, progress_read_at + PROGRESS_SECONDS - time.monotonic())
                await self._context.notifier.wait(notification, wait)
        finally:
            self._wake_watchers()

    def _accept(self, news: _News) -> None:
        """Store what has been read, and wake the watchers if any of it is new."""
        is_new_progress = news.progress not in (None, self._progress)
        is_new = bool(news.events) or news.has_ended or is_new_progress
        if news.events:
            self._after = self._newest
            self._events = news.events
        self._progress = news.progress or self._progress
        self._is_complete = news.has_ended
        if is_new:
            self._wake_watchers()

    def _wake_watchers(self) -> None:
        # Each watcher waits for the event that it saw before it read.
        self._changed.set()
        self._changed = asyncio.Event()


def _message(name: EventName, data: str, identifier: int) -> bytes:
    return f"id: {identifier}\nevent: {name}\ndata: {data}\n\n".encode()
