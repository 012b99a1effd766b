"""Transactions on the database, whichever it is: SQLite in the data directory, or PostgreSQL by a URL.

There is one way to read and one to write. A write is alone in writing from its first statement on: it never finds at
its end that somebody else was faster, so nothing has to be tried again.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from enum import Enum, auto
from itertools import islice
from typing import Any, TypeVar

from sqlalchemy import Connection, Engine, Table, event
from sqlalchemy.pool import ConnectionPoolEntry

T = TypeVar("T")

BATCH = 5000
"""How many values go into one IN (...) and how many rows into one executemany."""


class Role(Enum):
    """Who opens a database. Any number of coordinators may share one; upkeep has it for itself."""

    coordinator = auto()
    upkeep = auto()
    visitor = auto()
    """One who reads and writes a row or two beside the others."""


class Database(ABC):
    """Transactions on one database."""

    def __init__(self, reader: Engine, writer: Engine) -> None:
        self._reader = reader
        self._writer = writer
        # The database's own waiting is unfair, or takes a connection; threads of this process queue up here.
        self._writing = threading.Lock()
        self._ahead = time.time() - time.monotonic()

    def clock(self) -> float:
        """Return what all coordinators on this database call now, in seconds since 1970 [s].

        When somebody sets this machine's clock, leases neither expire at once nor live forever.
        """
        return self._ahead + time.monotonic()

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Open a transaction that sees one state of the database."""
        with self._reader.begin() as connection:
            yield connection

    @abstractmethod
    def write(self) -> AbstractContextManager[Connection]:
        """Open a transaction that is alone in writing; it is durable when the block has been left."""

    def is_alone(self, connection: Connection) -> bool:
        """Tell, in a write, whether no other coordinator uses the database."""
        return True

    async def listen(self, ring: Callable[[], None]) -> None:
        """Call `ring` whenever another coordinator has written, until cancelled."""
        return

    def close(self) -> None:
        """Close all connections; one that a thread still uses, as soon as the thread has done with it."""
        for engine in (self._reader, self._writer):
            event.listen(engine, "checkin", _close_returned)
            engine.dispose()


def _close_returned(_connection: Any, record: ConnectionPoolEntry) -> None:
    record.close()


def batches(items: Iterable[T], size: int = BATCH) -> Iterator[list[T]]:
    """Yield `items` in lists of at most `size`."""
    iterator = iter(items)
    while batch := list(islice(iterator, size)):
        yield batch


def insert_rows(connection: Connection, table: Table, columns: Sequence[str], rows: Iterable[tuple[Any, ...]]) -> None:
    """Insert many rows by the driver's own executemany: an SQL expression per row would cost five times as much."""
    mark = {"qmark": "?", "format": "%s"}[connection.dialect.paramstyle]
    statement = f"INSERT INTO {table.name} ({', '.join(columns)}) VALUES ({', '.join([mark] * len(columns))})"
    for batch in batches(rows, 20 * BATCH):
        connection.exec_driver_sql(statement, batch)
