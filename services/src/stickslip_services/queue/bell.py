"""A bell that the queue rings when something has happened, so that event streams need not keep looking."""

import asyncio
import threading
from contextlib import suppress


class Bell:
    """Wakes all that wait; may be rung from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()
        self._rung = 0

    @property
    def rung(self) -> int:
        """How many times it has been rung: to be taken before looking, and handed to `wait`."""
        return self._rung

    def ring(self) -> None:
        """Wake everyone who waits."""
        with self._lock:
            self._rung += 1
            waiting, self._waiting = self._waiting, set()
        for loop, event in waiting:
            with suppress(RuntimeError):  # the loop is closed: nobody waits there any more
                loop.call_soon_threadsafe(event.set)

    async def wait(self, seen: int, timeout: float) -> None:
        """Return when the bell has been rung more than `seen` times, or after `timeout` seconds."""
        entry = (asyncio.get_running_loop(), asyncio.Event())
        with self._lock:
            if self._rung != seen:
                return
            self._waiting.add(entry)
        try:
            with suppress(TimeoutError):
                await asyncio.wait_for(entry[1].wait(), timeout)
        finally:
            with self._lock:
                self._waiting.discard(entry)
