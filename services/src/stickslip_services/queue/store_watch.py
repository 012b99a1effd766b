"""Whether the store can take results. While it cannot, jobs are paused and say why; afterwards they go on.

Two ways lead to trouble: the coordinator itself looks, or a worker reports that it could not write.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

HOLD_SECONDS = 10.0
"""How long a worker's word counts where the coordinator itself finds nothing wrong [s]."""

_PROBE_BYTES = 4096


class StoreWatch:
    """Looks at the directories of the store and of the database."""

    def __init__(self, store: Path, data: Path, *, min_free_bytes: int, clock: Callable[[], float]) -> None:
        self._store = store
        self._data = data
        self._min_free_bytes = min_free_bytes
        self._clock = clock
        self._reported = ""
        self._reported_until = float("-inf")
        self.trouble = ""
        """What is wrong, in words; empty where nothing is."""

    def look(self) -> str:
        """Look again; return what is wrong."""
        reported = self._reported if self._clock() < self._reported_until else ""
        self.trouble = self._fault() or reported
        return self.trouble

    def note(self, message: str) -> None:
        """Take a worker's word that the store cannot be written."""
        self._reported = message
        self._reported_until = self._clock() + HOLD_SECONDS
        self.trouble = self.trouble or message

    def _fault(self) -> str:
        for place in (self._store, self._data):
            try:
                place.mkdir(parents=True, exist_ok=True)
                free = shutil.disk_usage(place).free
                if free < self._min_free_bytes:
                    return f"{place} has {_mib(free)} MiB left, and {_mib(self._min_free_bytes)} MiB must stay free"
                _probe(place / f".probe-{os.getpid()}")
            except OSError as error:
                return f"{place} cannot be written: {error.strerror or error}"
        return ""


def _probe(path: Path) -> None:
    try:
        with path.open("wb") as file:
            file.write(bytes(_PROBE_BYTES))
            file.flush()
            os.fsync(file.fileno())
    finally:
        path.unlink(missing_ok=True)


def _mib(size: int) -> str:
    return f"{size / 2**20:.3g}"
