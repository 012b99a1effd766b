"""Monitoring of the store. While it takes no results, jobs are paused; afterwards they resume.

Trouble is found by a look of the coordinator, or reported by a worker that could not write.
"""

from collections.abc import Callable
from pathlib import Path

from stickslip_schemas.store import DirectoryStore, Store

HOLD_SECONDS = 10.0
"""Duration of a worker's report, if the coordinator itself finds no fault [s]."""

PROBE_SECONDS = 10.0
"""Time between two probes of a working bucket [s]: each probe costs requests."""


class StoreWatch:
    """Monitors the store and the directory of the database."""

    def __init__(self, store: Store, data: Path, *, min_free_bytes: int, clock: Callable[[], float]) -> None:
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
        least = self._min_free_bytes
        for looked_at in self._places:
            try:
                room = looked_at.room()
                if room is not None and room.free < least:
                    return f"{looked_at.place} has {_mib(room.free)} MiB left, and {_mib(least)} MiB must stay free"
                if room is None and not self.trouble:
                    if self._clock() < self._next_probe:
                        continue
                    self._next_probe = self._clock() + PROBE_SECONDS
                looked_at.probe()
            except OSError as error:
                return f"{looked_at.place} cannot be written: {error.strerror or error}"
        return ""


def _mib(size: int) -> str:
    return f"{size / 2**20:.3g}"
