"""The notifier: wakes event streams when the queue has changed, so that they need not poll."""

import asyncio
import threading
from contextlib import suppress


class Notifier:
    """Wakes all waiters; `notify` may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()
        self._count = 0

    @property
    def count(self) -> int:
        """Number of notifications so far: read it before looking for news, and pass it to `wait`."""
        return self._count

    def notify(self) -> None:
        """Wake all waiters."""
        with self._lock:
            self._count += 1
            waiting, self._waiting = self._waiting, set()
        for loop, event in waiting:
            with suppress(RuntimeError):  # the loop is closed: nobody waits there any more
                loop.call_soon_threadsafe(event.set)

    async def wait(self, seen: int, timeout: float) -> None:
        """Return when there have been more than `seen` notifications, or after `timeout` seconds."""
        entry = (asyncio.get_running_loop(), asyncio.Event())
        with self._lock:
            if self._count != seen:
                return
            self._waiting.add(entry)
        try:
            with suppress(TimeoutError):
                await asyncio.wait_for(entry[1].wait(), timeout)
        finally:
            with self._lock:
                self._waiting.discard(entry)
