"""The context of one coordinator: the shared objects of the queue, and its state in memory.

The coordinator watches the store. While the store takes no results, it pauses jobs, and later it
resumes them. A check of the coordinator finds a fault, or a worker that could not write reports
one.
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
from stickslip_services.queue.job_builds import JobBuilds
from stickslip_services.queue.transaction import QueueTransaction
from stickslip_services.settings import Settings

HOLD_SECONDS = 10.0
"""Time for which a worker's report counts if the coordinator itself finds no fault [s]."""

PROBE_SECONDS = 10.0
"""Time between two probes of a working bucket [s].

Each probe costs requests.
"""


class Turns:
    """The order in which projects got their last tasks, as numbers that grow.

    A restart loses it.
    """

    def __init__(self) -> None:
        self._last: dict[str, int] = {}
        self._turn = 0

    def last(self, project: str) -> int:
        """Return the last turn of a project, or 0 before its first."""
        return self._last.get(project, 0)

    def take(self, project: str) -> int:
        """Give a project the next turn, and return it."""
        self._turn += 1
        self._last[project] = self._turn
        return self._turn


class StoreWatch:
    """Monitors the store and the directory of the database."""

    def __init__(
        self, store: Store, data: Path, *, min_free_bytes: int, clock: Callable[[], float]
    ) -> None:
        self._stores: tuple[Store, ...] = (store, DirectoryStore(data))
        self._min_free_bytes = min_free_bytes
        self._clock = clock
        self._reported = ""
        self._reported_until = float("-inf")
        self._next_probe = float("-inf")
        self.trouble = ""
        """Description of the fault, or an empty text."""

    def check(self) -> str:
        """Check the store again, and return the fault."""
        reported = self._reported if self._clock() < self._reported_until else ""
        self.trouble = self._fault() or reported
        return self.trouble

    def report(self, message: str) -> None:
        """Record a worker's report that the store cannot be written."""
        self._reported = message
        self._reported_until = self._clock() + HOLD_SECONDS
        self.trouble = self.trouble or message

    def _fault(self) -> str:
        for store in self._stores:
            try:
                fault = self._fault_of(store)
            except OSError as error:
                return f"{store.place} cannot be written: {error.strerror or error}"
            if fault:
                return fault
        return ""

    def _fault_of(self, store: Store) -> str:
        """Return the fault of one store.

        Raises OSError if the store cannot be written.
        """
        room = store.disk_usage()
        if room is not None and room.free < self._min_free_bytes:
            free = room.free / 2**20
            least = self._min_free_bytes / 2**20
            return f"{store.place} has {free:.3g} MiB left, and {least:.3g} MiB must stay free"
        if room is None and not self.trouble:
            # A bucket has no disk usage, and each probe of it costs requests. So a working bucket
            # gets few probes.
            if self._clock() < self._next_probe:
                return ""
            self._next_probe = self._clock() + PROBE_SECONDS
        store.probe()
        return ""


class Notifier:
    """Wakes event streams when the queue has changed.

    Any thread may call `notify`.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: set[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = set()
        self.count = 0
        """Number of notifications so far.

        Read it before looking for news, and pass it to `wait`.
        """

    def notify(self) -> None:
        with self._lock:
            self.count += 1
            waiting, self._waiting = self._waiting, set()
        for loop, event in waiting:
            with suppress(RuntimeError):  # the loop is closed: nobody waits there any more
                loop.call_soon_threadsafe(event.set)

    async def wait(self, since: int, timeout: float) -> None:
        """Return when there have been more than `since` notifications, or after `timeout` [s]."""
        entry = (asyncio.get_running_loop(), asyncio.Event())
        with self._lock:
            # A notification may have come between the caller's look for news and this call.
            if self.count != since:
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

    A restart loses the values that exist only in memory.
    """

    settings: Settings
    database: Database
    clock: Clock
    store: Store
    store_watch: StoreWatch
    notifier: Notifier = field(default_factory=Notifier)
    frames_by_worker: dict[str, dict[str, tuple[int, int]]] = field(default_factory=dict)
    """Progress of simulations by worker and task: (frames done, frames total).

    Each heartbeat of a worker replaces the progress of its tasks.
    """
    sections: dict[str, tuple[Sha256, ...]] = field(default_factory=dict)
    """Temporary artifacts with the sections of publish tasks, by task.

    `gc` finds the artifacts of an earlier process.
    """
    job_builds: JobBuilds = field(default_factory=JobBuilds)
    turns: Turns = field(default_factory=Turns)
    next_job_check: float = float("-inf")
    """Time of the next check of the active jobs for damaged rows [s since 1970]."""
    no_check_since: int = -1
    """Number of writes when no job waited for a check of its dataset (`existing_datasets`)."""
    last_situation: tuple[int, tuple[tuple[str, str], ...]] | None = None
    """Number of writes and states of the workers when `workers` last looked for unschedulable jobs.
    """
    next_situation_check: float = float("-inf")
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
        """Open a write transaction, and notify watchers after the commit."""
        with self.database.write() as connection:
            yield QueueTransaction(connection, self.clock())
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
