"""The context of one coordinator: what the verbs of the queue share, and its state in memory.

The store is watched: while it takes no results, jobs are paused; afterwards they resume. Trouble is
found by a look of the coordinator, or reported by a worker that could not write.
"""

import asyncio
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from stickslip_schemas.base import Sha256
from stickslip_schemas.store import DirectoryStore, Store, open_store

from stickslip_services.database.database import Clock, Database, Role
from stickslip_services.database.opening import connect
from stickslip_services.queue.transaction import QueueTransaction, queue_transaction
from stickslip_services.settings import Settings

HOLD_SECONDS = 10.0
"""Duration of a worker's report, if the coordinator itself finds no fault [s]."""

PROBE_SECONDS = 10.0
"""Time between two probes of a working bucket [s]: each probe costs requests."""


class StoreWatch:
    """Monitors the store and the directory of the database."""

    def __init__(
        self, store: Store, data: Path, *, min_free_bytes: int, clock: Callable[[], float]
    ) -> None:
        self._places: tuple[Store, ...] = (store, DirectoryStore(data))
        self._min_free_bytes = min_free_bytes
        self._clock = clock
        self._reported = ""
        self._reported_until = float("-inf")
        self._next_probe = float("-inf")
        self.trouble = ""
        """Description of the fault; empty without one."""

    def look(self) -> str:
        """Check again; return the fault."""
        reported = self._reported if self._clock() < self._reported_until else ""
        self.trouble = self._fault() or reported
        return self.trouble

    def note(self, message: str) -> None:
        """Note a worker's report that the store cannot be written."""
        self._reported = message
        self._reported_until = self._clock() + HOLD_SECONDS
        self.trouble = self.trouble or message

    def _fault(self) -> str:
        for looked_at in self._places:
            try:
                room = looked_at.disk_usage()
                if room is not None and room.free < self._min_free_bytes:
                    left, least = room.free / 2**20, self._min_free_bytes / 2**20
                    return f"{looked_at.place} has {left:.3g} MiB left, and {least:.3g} MiB must stay free"
                if room is None and not self.trouble:
                    if self._clock() < self._next_probe:
                        continue
                    self._next_probe = self._clock() + PROBE_SECONDS
                looked_at.probe()
            except OSError as error:
                return f"{looked_at.place} cannot be written: {error.strerror or error}"
        return ""


class Notifier:
    """Wakes event streams when the queue has changed; `notify` may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()
        self.count = 0
        """Number of notifications so far: read it before looking for news, and pass it to `wait`.
        """

    def notify(self) -> None:
        with self._lock:
            self.count += 1
            waiting, self._waiting = self._waiting, set()
        for loop, event in waiting:
            with suppress(RuntimeError):  # the loop is closed: nobody waits there any more
                loop.call_soon_threadsafe(event.set)

    async def wait(self, seen: int, timeout: float) -> None:
        """Return when there have been more than `seen` notifications, or after `timeout` seconds."""
        entry = (asyncio.get_running_loop(), asyncio.Event())
        with self._lock:
            if self.count != seen:
                return
            self._waiting.add(entry)
        try:
            with suppress(TimeoutError):
                await asyncio.wait_for(entry[1].wait(), timeout)
        finally:
            with self._lock:
                self._waiting.discard(entry)


@dataclass(slots=True)
class Context:
    """Database, store, clock and settings of a coordinator.

    What is in memory only is lost with a restart.
    """

    settings: Settings
    database: Database
    clock: Clock
    store: Store
    store_watch: StoreWatch
    notifier: Notifier = field(default_factory=Notifier)
    frames_by_worker: dict[str, dict[str, tuple[int, int]]] = field(default_factory=dict)
    """Progress of simulations from the last heartbeat of each worker: (frames done, frames total)
    by task.
    """
    sections: dict[str, tuple[Sha256, ...]] = field(default_factory=dict)
    """Temporary artifacts with the sections of publish tasks, by task. `gc` finds those of an
    earlier process.
    """
    is_closing: bool = False

    @classmethod
    def open(
        cls, settings: Settings, clock: Clock | None = None, role: Role = Role.coordinator
    ) -> "Context":
        """Connect to the database and the store.

        `clock` replaces the clock of the database, for tests.
        """
        database, store = connect(settings, role), open_store(settings.store_place)
        clock = clock or database.clock
        watch = StoreWatch(
            store, settings.data, min_free_bytes=settings.min_free_bytes, clock=clock
        )
        return cls(settings, database, clock, store, watch)

    def close(self) -> None:
        self.is_closing = True
        self.database.close()

    @contextmanager
    def transaction(self) -> Iterator[QueueTransaction]:
        """Open a write transaction with a ledger; notify watchers after the commit."""
        with self.database.write() as connection, queue_transaction(connection, self.clock()) as tx:
            yield tx
        self.notifier.notify()

    @property
    def frames(self) -> dict[str, tuple[int, int]]:
        """Progress of running simulations by task: (frames done, frames total)."""
        return {
            task: frames
            for by_task in list(self.frames_by_worker.values())
            for task, frames in by_task.items()
        }

    @property
    def alive_since(self) -> float:
        """Workers whose last message is older than this are presumed lost [s since 1970]."""
        return self.clock() - self.settings.lease_seconds
